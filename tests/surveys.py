"""A survey without photos: the tracks of sample_scenes/flyover, with GPS and control points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
from solved_scene import SCENES, cameras_of

from rsundistort import Observations, Reconstruction, SolveOptions, read_solution
from rsundistort.batch.progress import StageLog
from rsundistort.io import ExifFacts, GpsFix
from rsundistort.model import ControlPoint
from rsundistort.solve.model_sequence import solve_tracks
from rsundistort.solve.survey import survey_of

ORIGIN = (47.0, 8.0, 400.0)
READOUT_S = 0.033


def geodetic_of(enu, origin=ORIGIN):
    """Latitudes, longitudes and altitudes (m, 3) of metres east, north and up of an origin, by pyproj."""
    latitude, longitude, height = origin
    back = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={longitude} +lat_0={latitude} +h_0={height} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    east, north, up = back.transform(*np.asarray(enu, float).T)
    return np.stack([north, east, up], axis=1)


class Flight:
    """What is true of the scene, in metres east, north and up; with measurements but for points kept as control."""

    def __init__(self, noise_px=0.2, seed=0, scene: Path = SCENES / "flyover"):
        self.rng = np.random.default_rng(seed)
        truth, tracks = read_solution(scene / "ground_truth.json"), np.load(scene / "tracks.npz")
        self.names = tracks["image_names"].tolist()
        self.center_w, self.points_w = tracks["center_w"], tracks["points_w"]
        motions = [truth.image(name).motion for name in self.names]
        self.phi, self.velocity = (np.array([getattr(each, what) for each in motions]) for what in ("phi", "velocity"))
        self.seen = np.isfinite(tracks["xy_raw"]).all(1)
        self.true_xy = tracks["xy_raw"]
        self.xy = self.true_xy + self.rng.normal(0, noise_px, self.true_xy.shape)
        self.frame_idx, self.point_idx = tracks["frame_idx"], tracks["point_idx"]
        counts = np.bincount(self.point_idx[self.seen], minlength=len(self.points_w))
        ground = np.flatnonzero((counts >= 4) & (np.abs(self.points_w[:, 2]) < 6))
        self.marked = self.rng.choice(ground, 12, replace=False).tolist()
        use = self.seen & ~np.isin(self.point_idx, self.marked)
        obs = Observations(self.frame_idx[use], self.point_idx[use], self.xy[use])
        start = Reconstruction(
            [truth.cameras["1"]], self.names, np.zeros(len(self.names), int), tracks["R_cw"], self.center_w,
            self.points_w, obs,
        )  # fmt: skip
        self.unmoved = start
        # a frame of its own, as that of a mapping
        self.start = start.with_points(np.ones(len(obs), bool)).normalized()

    def truth(self):
        """The true reconstruction, in metres."""
        return replace(self.unmoved, phi=self.phi, velocity=self.velocity, shutter_model="constant-motion")

    def facts(self, sigma_m=(0.5, 0.5, 1.0), off=(), stated=None, names=None, speed_sigma=None):
        """EXIF facts with GPS of that noise; photos `off` are 60 m away."""
        noise = self.rng.normal(size=self.center_w.shape) * sigma_m
        noise[list(off), 0] += 60.0
        sigma = tuple(float(each) for each in (sigma_m if stated is None else stated))
        places = geodetic_of(self.center_w + noise).tolist()
        moving = [None] * len(places)
        if speed_sigma is not None:
            per_second = 512 / 640 / READOUT_S
            moving = (per_second * self.velocity + speed_sigma * self.rng.normal(size=(len(places), 3))).tolist()
        found = [
            ExifFacts(fix=GpsFix(*each, sigma_m=sigma, altitudes_m={"EXIF": each[2]}, velocity_m_s=way and tuple(way)))
            for each, way in zip(places, moving, strict=True)
        ]
        return [
            fact if names is None or name in names else ExifFacts()
            for name, fact in zip(self.names, found, strict=True)
        ]

    def control(self, num_control=6, sigma_m=0.02, click_px=0.5, of_place=lambda enu: enu):
        """Control points, and check points behind them, pointed at with noise."""
        found = []
        for k, point in enumerate(self.marked):
            mine = np.flatnonzero(self.seen & (self.point_idx == point))
            clicked = self.xy[mine] + self.rng.normal(0, click_px, (len(mine), 2))
            seen = {self.names[self.frame_idx[i]]: tuple(xy) for i, xy in zip(mine, clicked.tolist(), strict=True)}
            place = of_place(self.points_w[point] + self.rng.normal(0, sigma_m, 3))
            found.append(ControlPoint(f"P{k}", tuple(map(float, place)), (sigma_m,) * 3, seen, k >= num_control))
        return found

    def exact_checks(self, num_control=6, of_place=lambda enu: enu):
        """The check points again, surveyed and pointed at without an error (a millimetre is the least said)."""
        found = []
        for k, point in enumerate(self.marked[num_control:], num_control):
            mine = np.flatnonzero(self.seen & (self.point_idx == point))
            exact = self.true_xy[mine].tolist()
            seen = {self.names[self.frame_idx[i]]: tuple(xy) for i, xy in zip(mine, exact, strict=True)}
            place = tuple(map(float, of_place(self.points_w[point])))
            found.append(ControlPoint(f"P{k} exact", place, (0.001,) * 3, seen, True))
        return found

    def solved(self, facts=None, crs=None, control=(), **options):
        """What is found of it."""
        asked = SolveOptions(**{"shutter_model": "constant-motion", "refine": (), **options})
        cameras, sizes = cameras_of(self.start), [(768, 512)] * len(self.names)
        facts = facts or [ExifFacts()] * len(self.names)
        survey = survey_of(crs, control, self.names, facts, sizes, dict.fromkeys(self.names, READOUT_S))
        return solve_tracks(
            self.start, cameras, asked.shutter_model, 0, lambda _: asked.options_for(cameras), StageLog(None),
            survey=survey,
        )  # fmt: skip


def with_readout(solved, seconds):
    """The same with a time of the readout."""
    return replace(solved, readouts={0: (seconds, "given")})
