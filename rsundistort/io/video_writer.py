"""Writing of a video."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

__all__ = ["X264_PARAMS", "write_video"]

#: Without its macroblock tree, which decides by memory that x264 (build 165) never wrote: its bytes then depend on what
#: ran before.
X264_PARAMS = "mbtree=0"


def write_video(path: Path | str, frames: Iterable[NDArray[np.uint8]], fps: Fraction, crf: int = 8) -> None:
    """Write frames as H.264 in MP4, at a constant rate; the same bytes for the same pixels and x264.

    Colours keep their full resolution (4:4:4): halved, it alone costs 2 dB. FFmpeg reads that, few browsers do.

    Parameters
    ----------
    path : path
        File to write; its folder exists.
    frames : iterable of (h, w, 3) uint8 arrays
        BGR, all of one size, of even width and height. One is held in memory at a time.
    fps : Fraction
        Frames a second.
    crf : int
        Constant rate factor of x264, 0 (without loss but for the rounding of colours) to 51.

    Raises
    ------
    InputError
        PyAV is missing, or the width or height is odd.
    """
    try:
        import av
    except ImportError:
        raise InputError('a video can be written by PyAV only: pip install "rsundistort[video]"') from None
    with av.open(f"file:{path}", "w", format="mp4") as container:
        stream: Any = None
        for pixels in frames:
            if stream is None:
                height, width = pixels.shape[:2]
                if height % 2 or width % 2:
                    raise InputError(f"a video of {width}x{height} pixels: H.264 needs an even width and height")
                # one thread: the bytes do not depend on how many there are
                stream = container.add_stream("libx264", rate=fps)
                stream.options = {"crf": str(crf), "preset": "slow", "x264-params": X264_PARAMS}
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv444p"
                stream.codec_context.thread_count = 1
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="bgr24")))
        if stream is not None:
            container.mux(stream.encode())
