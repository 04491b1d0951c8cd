"""A video that takes after another one: its times, its colours and its sound, with other pictures."""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import RsUndistortWarning
from .ffmpeg_reasons import ffmpeg_errors, open_video
from .video import VideoReader, bits_of
from .video_writer import X264_PARAMS

__all__ = ["Pixels", "VideoWriter", "black_out", "pixels_of"]

# The first of these that FFmpeg was built with; its options keep what a rectified photo would.
_ENCODERS = {"libx264": {"crf": "16", "x264-params": X264_PARAMS}, "mpeg4": {"qmin": "1", "qmax": "3"}}
# MPEG-4 counts in 16 bits.
_FINEST = {"mpeg4": 60000}
_MPEG4_BITS_PER_PIXEL = 4
_FULL_RANGE = 2  # FFmpeg's AVCOL_RANGE_JPEG
_BT709, _LIMITED_RANGE = 1, 1


@dataclass(frozen=True)
class Pixels:
    """A frame as numbers: luma and colour differences, all of the frame's size, as they are coded.

    Attributes
    ----------
    values : (h, w, 3) or (h, w) array
        uint8, or uint16 with the number in its low bits; grey has no colours.
    bits : int
        Of a number.
    full_range : bool
        Whether black is 0, and not 16 of 255.
    """

    values: NDArray[Any]
    bits: int
    full_range: bool

    @property
    def black(self) -> list[int]:
        """Value of black."""
        luma = 0 if self.full_range else 16 << (self.bits - 8)
        return [luma] if self.values.ndim == 2 else [luma, 1 << (self.bits - 1), 1 << (self.bits - 1)]


def black_out(pixels: Pixels, values: NDArray[Any], valid: NDArray[np.uint8]) -> Pixels:
    """A frame of such values, black where nothing was seen; interpolation may have gone beyond the largest number."""
    if pixels.bits not in (8, 16):
        np.minimum(values, (1 << pixels.bits) - 1, out=values)
    values[valid == 0] = pixels.black if values.ndim == 3 else pixels.black[0]
    return Pixels(values, pixels.bits, pixels.full_range)


def _own_planes(form: Any) -> bool:
    """Whether the numbers of a format are read as they stand: planes of luma and colour differences, or of grey."""
    planar = (form.is_planar and len(form.components) == 3) or (len(form.components) == 1 and form.name[:4] == "gray")
    return bool(planar and not form.is_rgb and not form.is_big_endian and not form.has_palette)


def _readable(picture: Any) -> Any:
    """A picture of PyAV in a format whose numbers are read as they stand."""
    form = picture.format
    if _own_planes(form):
        return picture
    deep = bits_of(form) > 8
    if form.is_rgb or form.has_palette:
        made = picture.reformat(format="yuv444p10le" if deep else "yuv444p", dst_colorspace="ITU709")
        made.colorspace, made.color_range = _BT709, _LIMITED_RANGE
        return made
    # the same numbers in another order, such as nv12
    return picture.reformat(format="yuv420p10le" if deep else "yuv420p")


def _plane(plane: Any, width: int, height: int, bits: int) -> NDArray[Any]:
    size = 1 if bits == 8 else 2
    rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[:height, : size * width]
    return rows if size == 1 else np.ascontiguousarray(rows).view("<u2")


def pixels_of(picture: Any) -> Pixels:
    """The numbers of a picture of PyAV; colour differences are brought to the size of the luma."""
    picture = _readable(picture)
    form, width, height = picture.format, picture.width, picture.height
    bits = form.components[0].bits
    full = picture.color_range == _FULL_RANGE or form.name.startswith("yuvj")
    planes = [_plane(picture.planes[0], width, height, bits)]
    if len(form.components) == 3:
        size = form.chroma_width(width), form.chroma_height(height)
        for plane in picture.planes[1:3]:
            values = _plane(plane, *size, bits)
            grown = cv2.resize(np.ascontiguousarray(values), (width, height), interpolation=cv2.INTER_CUBIC)
            planes.append(np.minimum(grown, (1 << bits) - 1).astype(grown.dtype))
    values = planes[0].copy() if len(planes) == 1 else np.dstack(planes)
    return Pixels(values, bits, full)


def _picture_of(pixels: Pixels, form: str) -> Any:
    """A picture of PyAV in a format of planes."""
    import av

    height, width = pixels.values.shape[:2]
    picture = av.VideoFrame(width, height, form)
    bits, planes = picture.format.components[0].bits, len(picture.format.components)
    values = pixels.values
    if bits < pixels.bits:
        shift = pixels.bits - bits
        values = np.minimum((values.astype(np.uint32) + (1 << (shift - 1))) >> shift, (1 << bits) - 1).astype(np.uint8)
    if values.ndim == 2 and planes == 3:
        values = np.dstack([values, *(np.full_like(values, 1 << (bits - 1)) for _ in range(2))])
    size = picture.format.chroma_width(width), picture.format.chroma_height(height)
    for k in range(planes):
        plane = np.ascontiguousarray(values if values.ndim == 2 else values[..., k])
        if k and size != (width, height):
            plane = cv2.resize(plane, size, interpolation=cv2.INTER_AREA)
        coded = np.ascontiguousarray(plane).view("u1").reshape(plane.shape[0], -1)
        target = picture.planes[k]
        rows = np.zeros((target.buffer_size // target.line_size, target.line_size), "u1")
        rows[: coded.shape[0], : coded.shape[1]] = coded
        target.update(rows)
    return picture


class VideoWriter:
    """Writes frames into an MP4 file that has the rest from another video.

    Used in a `with` statement. Frames keep their time stamps, their colours mean the same, players rotate them alike,
    and the packets of sound are copied as they are.

    Parameters
    ----------
    reader : VideoReader
        Of the other video, open.
    width, height : int
        Of the new frames.
    """

    def __init__(self, path: Path, reader: VideoReader, width: int, height: int, threads: int = 0) -> None:
        self._path, self._reader, self._size, self._threads = path, reader, (width, height), threads
        self._stream: Any = None
        self._last: int | None = None
        self.num_late = 0
        self.encoder, self.pixel_format = "", ""

    def __enter__(self) -> VideoWriter:
        import av

        with self._explained():
            options = {"movflags": "faststart"}
            self._container = av.open(f"file:{self._path}", "w", format="mp4", options=options)
        self._sound = _Sound(self._reader.video, self._container)
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                with self._explained():
                    if self._stream is not None:
                        self._container.mux(self._stream.encode(None))
                    self._sound.pass_on(self._start_s, None)
                    self._sound.warn(self._reader.video.name)
        finally:
            with self._explained():
                self._container.close()
            self._sound.close()

    def add(self, pts: int, like: Any, pixels: Pixels) -> None:
        """Encode a frame.

        Parameters
        ----------
        pts : int
            Time stamp of the other video's stream. One that does not come after the last is left out, and counted in
            `num_late`.
        like : picture of PyAV
            Whose colours it has.
        pixels : Pixels
            Of the new size.
        """
        if self._last is not None and pts <= self._last:
            self.num_late += 1
            return
        self._last = pts
        with self._explained():
            if self._stream is None:
                self._begin(_readable(like), pixels)
            time = pts * self._reader.stream.time_base - self._start_s
            picture = _picture_of(pixels, self.pixel_format)
            picture.time_base = self._stream.codec_context.time_base
            picture.pts = round(time / picture.time_base)
            self._sound.pass_on(self._start_s, time)
            self._container.mux(self._stream.encode(picture))

    def _begin(self, like: Any, pixels: Pixels) -> None:
        """Say how frames are encoded, by the first of them."""
        import av

        source = self._reader.stream
        built = {name: av.codec.Codec(name, "w") for name in _ENCODERS if name in av.codecs_available}
        self.encoder, codec = next(iter(built.items()))
        known = {form.name for form in codec.video_formats or ()}
        self.pixel_format = next(
            name
            for name in (like.format.name, "yuv420p10le" if pixels.bits > 8 else "yuv420p", "yuv420p")
            if name in known
        )
        rate = source.average_rate or source.guessed_rate or Fraction(30)
        stream = self._container.add_stream(self.encoder, rate=rate, options=dict(_ENCODERS[self.encoder]))
        stream.width, stream.height = self._size
        stream.pix_fmt = self.pixel_format
        finest = _FINEST.get(self.encoder)
        base = source.time_base
        stream.time_base = base if finest is None or base.denominator <= finest else Fraction(1, finest)
        context = stream.codec_context
        context.time_base = stream.time_base
        context.thread_count = self._threads
        if self.encoder == "mpeg4":
            context.bit_rate = int(_MPEG4_BITS_PER_PIXEL * self._size[0] * self._size[1] * rate)
        if source.sample_aspect_ratio:
            context.sample_aspect_ratio = source.sample_aspect_ratio
        for name in ("color_range", "colorspace", "color_primaries", "color_trc"):
            setattr(context, name, getattr(like, name))
        if like.rotation:
            stream.set_display_rotation(like.rotation)
        for key, value in self._reader.tags.items():
            if key not in ("major_brand", "minor_version", "compatible_brands", "encoder"):
                self._container.metadata[key] = value
        self._stream = stream
        depth = bits_of(av.VideoFormat(self.pixel_format, 16, 16))
        if depth < pixels.bits:
            warnings.warn(
                f"{self._reader.video.name} has {pixels.bits} bits a colour, and {self.encoder} writes {depth}",
                RsUndistortWarning, stacklevel=4,
            )  # fmt: skip

    @property
    def _start_s(self) -> Fraction:
        """When the first stream of the other video begins, if that is late: transport streams begin at 1.4 s."""
        starts = [
            stream.start_time * stream.time_base
            for stream in self._reader.stream.container.streams
            if stream.start_time is not None and stream.type in ("video", "audio")
        ]
        return max(Fraction(0), min(starts, default=Fraction(0)))

    def _explained(self) -> AbstractContextManager[None]:
        return ffmpeg_errors("the rectified video cannot be written", reading=False)


class _Sound:
    """The sound of a video, copied packet by packet, a little ahead of the pictures."""

    def __init__(self, video: Path, container: Any) -> None:
        self._source = open_video(video)
        self._target: dict[int, Any] = {}
        self._lost: list[str] = []
        self._num_spoiled = 0
        for stream in self._source.streams.audio:
            name = stream.codec_context.name if stream.codec_context is not None else "unknown"
            if name in container.supported_codecs:
                self._target[stream.index] = container.add_stream_from_template(stream)
            else:
                self._lost.append(name)
        wanted = [self._source.streams[index] for index in self._target]
        self._container = container
        self._packets = self._source.demux(wanted) if wanted else iter(())
        self._next: Any = None

    def pass_on(self, start_s: Fraction, until_s: Fraction | None) -> None:
        """Copy the packets up to a time, all that is left for None."""
        import av

        while (packet := self._peek()) is not None:
            step = packet.time_base
            if until_s is not None and packet.dts * step - start_s > until_s:
                return
            self._next = None
            shift = round(start_s / step)
            packet.dts -= shift
            packet.pts = packet.dts if packet.pts is None else packet.pts - shift
            packet.stream = self._target[packet.stream.index]
            try:
                self._container.mux(packet)
            except (av.error.InvalidDataError, av.error.ArgumentError):  # the latter where its time runs back
                self._num_spoiled += 1

    def _peek(self) -> Any:
        """The packet that is due; None at the end, or where the file is damaged."""
        import av

        while self._next is None:
            try:
                packet = next(self._packets, None)
            except av.error.FFmpegError:
                packet = None
            if packet is None:
                return None
            if packet.dts is not None and packet.size:
                self._next = packet
        return self._next

    def warn(self, name: str) -> None:
        """Say what sound was left out."""
        if self._lost:
            said = ", ".join(sorted({*self._lost}))
            warnings.warn(
                f"{name}: sound that MP4 does not hold was left out ({said})", RsUndistortWarning, stacklevel=5
            )
        if self._num_spoiled:
            warnings.warn(
                f"{name}: {self._num_spoiled} damaged packets of sound were left out", RsUndistortWarning, stacklevel=5
            )

    def close(self) -> None:
        """Close the video."""
        self._source.close()
