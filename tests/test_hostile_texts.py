"""Texts that claim more than they hold: nested without end, numbers of thousands of digits, aliases of aliases."""

from __future__ import annotations

import time

import pytest

from rsundistort import read_solution
from rsundistort.errors import FormatError
from rsundistort.io.cameras import read_camera_file
from rsundistort.io.models import read_model
from rsundistort.io.nerfstudio import read_transforms
from rsundistort.io.photos.xmp import corrected_xmp, marked_xmp, rectified_by
from rsundistort.simulate.warp_folder import read_motion_file
from rsundistort.synthetic.recipe import load_recipe

READERS = {
    "solution": read_solution,
    "motion": read_motion_file,
    "transforms": read_transforms,
    "model": read_model,
    "recipe": load_recipe,
    "camera": lambda path: read_camera_file(path, 640, 480),
}
TEXTS = {
    "nested": '{"a":' * 100_000,
    "nested lists": "[" * 100_000 + "]" * 100_000,
    "digits": '{"version": ' + "9" * 5_000 + "}",
    "bytes": b'{"name": "\xff\xfe"}',
}
OURS = b'xmlns:r="urn:rsundistort:1.0/"'


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("text", TEXTS)
def test_a_text_that_is_no_json_is_one_line(tmp_path, reader, text):
    path = tmp_path / "x.json"
    content = TEXTS[text]
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises((FormatError, OSError)) as caught:
        READERS[reader](path)
    assert "x.json" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 500


def test_aliases_of_aliases_are_refused_at_once(tmp_path):
    levels = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    levels += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    (tmp_path / "camera.yaml").write_text("\n".join(levels))
    began = time.perf_counter()
    with pytest.raises(FormatError, match="aliases"):
        read_camera_file(tmp_path / "camera.yaml", 640, 480)
    assert time.perf_counter() - began < 2


def test_aliases_that_repeat_little_are_read(tmp_path):
    (tmp_path / "camera.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: x\ndistortion_model: plumb_bob\n"
        "camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}\n"
        "distortion_coefficients: {rows: 1, cols: 5, data: &zero [0, 0, 0, 0, 0]}\n"
        "other: *zero\n"
    )
    (camera,) = read_camera_file(tmp_path / "camera.yaml", 640, 480).cameras.values()
    assert camera.K[0, 0] == 500


@pytest.mark.parametrize(
    "packet",
    [
        b"<x " + OURS + b">" + b"<r:RectifiedBy>" * 20_000,
        b"<x " + OURS + b">" + b"<r:RectifiedBy " * 20_000,
        b"<x " + b" ".join(b'xmlns:r%d="urn:rsundistort:1.0/"' % k for k in range(20_000)) + b"/>",
    ],
)
def test_tags_that_are_never_closed_take_no_time(packet):
    began = time.perf_counter()
    assert rectified_by(packet) is None
    marked = marked_xmp(packet, "0.1")
    assert rectified_by(marked) == "0.1"
    corrected, problems = corrected_xmp(packet, 640, 480, 1)
    assert corrected == packet
    assert problems
    assert time.perf_counter() - began < 2
