"""Reports as tests read them, and solutions made by hand to be reported."""

from __future__ import annotations

import json
from html.parser import HTMLParser

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rsundistort import Camera, RowMotion, RsUndistortWarning, Solution, SolvedImage, write_solution
from rsundistort.report import write_report

CAMERA = Camera(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
CRITICAL = {
    "singular_values": [1.9, 1.3, 0.6, 0.4, 0.27],
    "null_vector": [1.0, 0, 0, 0, 0],
    "y_axis_spread_deg": 11.0,
    "meaning": "nothing",
    "sigma_log_k": 0.0003,
    "flagged": False,
    "remedy": "none needed",
    "anchors": {},
    "sentence": "the height of the scene is uncertain by +-0.03 % (one standard deviation)",
    "warnings": [],
    "advice": [],
}


class Page(HTMLParser):
    """What a report is made of: its sections, links, scripts, and the text of each element of interest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sections: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.scripts: list[str] = []
        self.text = ""
        self._script = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append(tag)
        if tag == "section":
            self.sections.append(given["id"])
        if tag == "a":
            self.links.append(given.get("href", ""))
        self.fetched += [v for k, v in attrs if k in ("src", "srcset", "data") or (k == "href" and tag != "a")]
        self.fetched += [k for k, _ in attrs if k.startswith("on")]
        if tag == "script":
            self._script = True
            self.scripts.append("")

    def handle_endtag(self, tag):
        self._script = self._script and tag != "script"

    def handle_data(self, data):
        if self._script:
            self.scripts[-1] += data
        else:
            self.text += data

    @property
    def data(self):
        return json.loads(self.scripts[0])


def page_of(out) -> Page:
    return Page((out / "report.html").read_text("utf-8"))


def hand_made(
    names=("a.png", "b.png", "c.png"), critical=None, shutter_model="rotation", shift=12.0, **more
) -> Solution:
    """A solution of small photos on an arc, said to be as good as the courtyard's."""
    images = tuple(
        SolvedImage(
            name, "1", Rotation.from_euler("yx", [0.1 * i, 0.05 * i * i]).as_matrix(), np.array([i, 0.1 * i * i, 0.0]),
            RowMotion([0.02, -0.01, 0.03]), np.full(3, 1e-4), 100, 0.2, shift / (1 + i),
        )
        for i, name in enumerate(names)
    )  # fmt: skip
    critical = None if critical is False else CRITICAL | (critical or {})
    return Solution(shutter_model, {"1": CAMERA}, {"1": CAMERA.pinhole()}, images, critical, **more)


def quietly(*args, **kwargs):
    """A report of which nothing is missing that anybody asked for."""
    with pytest.warns(RsUndistortWarning) as caught:
        write_report(*args, **kwargs)
    return [str(each.message) for each in caught]


def write_solution_to(out, solution) -> None:
    out.mkdir(parents=True, exist_ok=True)
    write_solution(out / "solution.json", solution)
