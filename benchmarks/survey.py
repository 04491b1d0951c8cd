"""Surveys: photos on the map by GPS and control points; prints one JSON object a line.

    python benchmarks/survey.py [flights] [rendered] [drone] [--trials N] [--keep FOLDER]

`flights`: the tracks of sample_scenes/flyover (40 m high, 0.0625 m on the ground a pixel, 12.1 m/s, 33 ms), measured
with 0.2 px; GPS of 0.5, 0.5 and 1 m a photo and an offset of 12 m in height that all share; six control points (0.02 m,
pointed at with 0.5 px) and six check points, none of them among the tracks. Check points: residuals in metres and in
their standard deviations, the share within two of these, and the speed; once with GPS's velocities (0.2 m/s), once
without, over N flights.
`rendered`: its rendered photos with that in EXIF and XMP, through `run`, in EPSG:32632; `exact`: the same check points
surveyed and pointed at without an error; `floor_m`: what survey and pointing alone leave, in true cameras.
`drone`: ../shared/photos/drone, GPS of a fixed-wing drone: residuals of positions, heights against those of the XMP
(above the place of take-off, used as priors) and against GPS's (used for their level only), and how well the frame is
known.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import struct
import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from rsundistort import RectifyOptions, RunOptions, SolveOptions, read_solution, run
from rsundistort.bundle.control import place_control
from rsundistort.io import read_control_points, read_exif
from rsundistort.solve import OutputOptions
from rsundistort.solve.outcome import solution_of

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
from surveys import READOUT_S, Flight, geodetic_of, with_readout  # noqa: E402

DRONE = ROOT.parent / "shared" / "photos" / "drone"
GROUND_M = 40 / 640
CRS, OFFSET_M = "EPSG:32632", 12.0
UTM = pyproj.Transformer.from_crs(4326, CRS, always_xy=True)


def in_utm(enu: np.ndarray) -> list[float]:
    latitude, longitude, height = geodetic_of([enu])[0]
    return [*UTM.transform(longitude, latitude), height]


def facts_of(flight: Flight, **options: Any) -> list[Any]:
    """EXIF facts whose altitudes are off by as much."""
    return [replace(f, fix=replace(f.fix, altitude_m=f.fix.altitude_m + OFFSET_M)) for f in flight.facts(**options)]


def check_figures(georeferenced: list[dict[str, Any]], exact: bool = False) -> dict[str, Any]:
    """What check points of georeferences come to."""
    named = [item for one in georeferenced for item in one["control"].items()]
    checks = [each for name, each in named if each["use"] == "check" and name.endswith("exact") == exact]
    off = np.array([each["residual_m"] for each in checks])
    deviations = off / [each["sigma_m"] for each in checks]
    speeds = [each["speed_m_s"] for one in georeferenced for each in one["speeds"].values()]
    return {
        "check_points": len(checks),
        "rms_m": np.sqrt(np.mean(off**2, axis=0)).round(4).tolist(),
        "rms_ground_px": np.sqrt(np.mean(off**2, axis=0) / GROUND_M**2).round(3).tolist(),
        "within_2_sigma": np.mean(np.abs(deviations) < 2, axis=0).round(3).tolist(),
        "rms_deviations": np.sqrt(np.mean(deviations**2, axis=0)).round(3).tolist(),
        "speed_m_s": round(float(np.median(speeds)), 2) if speeds else None,
    }


def flights(trials: int) -> None:
    for speed_sigma in (0.2, None):
        georeferenced = []
        for seed in range(trials):
            flight = Flight(seed=seed)
            solved = flight.solved(facts_of(flight, speed_sigma=speed_sigma), CRS, flight.control(of_place=in_utm))
            found = solution_of(with_readout(solved, READOUT_S), SolveOptions(), RectifyOptions()).georeference
            georeferenced.append(found)
        print(json.dumps({"flights": trials, "gps_velocity": speed_sigma is not None, **check_figures(georeferenced)}))


def with_position(photo: bytes, fact: Any) -> bytes:
    """A JPEG with GPS in EXIF, and velocities in XMP as DJI has them."""
    from PIL import Image

    exif, fix = Image.Exif(), fact.fix
    gps = exif.get_ifd(0x8825)
    for at, letters, value in ((1, "NS", fix.latitude_deg), (3, "EW", fix.longitude_deg)):
        minutes = abs(value) % 1 * 60
        gps[at], gps[at + 1] = letters[value < 0], (int(abs(value)), int(minutes), round(minutes % 1 * 60, 6))
    gps[5], gps[6] = b"\0", fix.altitude_m
    gps[31] = 0.75  # a radius of 68 %
    east, north, up = fix.velocity_m_s
    xmp = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:FlightXSpeed="{north:.1f}" '
        f'drone-dji:FlightYSpeed="{east:.1f}" drone-dji:FlightZSpeed="{-up:.1f}"/></rdf:RDF></x:xmpmeta>'
    ).encode()
    block = exif.tobytes()
    segments = [block if block.startswith(b"Exif") else b"Exif\0\0" + block, b"http://ns.adobe.com/xap/1.0/\0" + xmp]
    return photo[:2] + b"".join(b"\xff\xe1" + struct.pack(">H", len(s) + 2) + s for s in segments) + photo[2:]


def write_survey(folder: Path, seed: int = 0) -> None:
    """Photos with positions, the camera, and `gcp.csv` beside them."""
    flight, scene = Flight(seed=seed, noise_px=0.0), ROOT / "sample_scenes" / "flyover"
    (folder / "photos").mkdir(parents=True)
    for name, fact in zip(flight.names, facts_of(flight, speed_sigma=0.2), strict=True):
        (folder / "photos" / name).write_bytes(with_position((scene / "photos" / name).read_bytes(), fact))
    shutil.copy(scene / "camera.json", folder)
    with (folder / "gcp.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["name", "photo", "x", "y", "E", "N", "U", "sigma_m", "use"])
        for point in flight.control(of_place=in_utm) + flight.exact_checks(of_place=in_utm):
            use = "check" if point.is_check else "control"
            for photo, (x, y) in point.seen.items():
                writer.writerow([point.name, photo, f"{x:.4f}", f"{y:.4f}", *point.place_m, point.sigma_m[0], use])


def floor() -> list[float]:
    """Standard deviations of check points in true cameras, by their survey and pointing alone, rms over the points."""
    flight = Flight(noise_px=0.0)
    placed = place_control(flight.truth(), flight.control())
    variance = [
        np.asarray(point.sigma_m) ** 2 + np.diagonal(covariance)
        for point, covariance in zip(placed.points, placed.covariance, strict=True)
        if point.is_check
    ]
    return np.sqrt(np.mean(variance, axis=0)).round(4).tolist()


def rendered(work: Path) -> None:
    write_survey(work)
    control = read_control_points(work / "gcp.csv")
    solve = SolveOptions(crs=CRS, control=control, readout_s=READOUT_S)
    run(work / "photos", work / "out", RunOptions(solve=solve, outputs=OutputOptions(report=True)), overwrite=True)
    georeferenced = read_solution(work / "out" / "solution.json").georeference
    assert georeferenced is not None
    figures = {
        "rendered": check_figures([georeferenced]),
        "exact": check_figures([georeferenced], exact=True),
        "floor_m": floor(),
    }
    print(json.dumps({**figures, "gps_offset_m": georeferenced["gps"]["offset_m"], "sigma": georeferenced["sigma"]}))


def drone(work: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        solution = run(DRONE, work / "drone", RunOptions(outputs=OutputOptions(report=True)), overwrite=True)
    georeferenced = solution.georeference
    assert georeferenced is not None
    gps = georeferenced["gps"]
    height, above, altitude = [], [], []
    for image in solution.registered:
        fix = read_exif(DRONE / image.name).fix
        if fix is not None and fix.height_m is not None:
            height.append(fix.height_m)
            above.append(image.center_w[2])
            altitude.append(fix.altitude_m)
    apart, apart_of_gps = np.array(above) - height, np.array(above) - altitude
    print(
        json.dumps(
            {
                "drone": len(gps["photos"]),
                "median_m": round(gps["median_m"], 2),
                "rms_axes_m": np.round(gps["rms_axes_m"], 2).tolist(),
                "outliers": gps["outliers"],
                "sigma_place_m": np.round(georeferenced["sigma"]["place_m"], 2).tolist(),
                "sigma_scale": round(georeferenced["sigma"]["scale"], 4),
                "height_above_take_off_m": [round(min(height), 1), round(max(height), 1)],
                "heights_apart_m": round(float(np.std(apart)), 2),
                "altitudes_apart_m": round(float(np.std(apart_of_gps)), 2),
                "notes": georeferenced["notes"],
            }
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["flights", "rendered", "drone"])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = given.keep or Path(folder)
        for part in given.parts:
            if part == "flights":
                flights(given.trials)
            elif part == "rendered":
                rendered(work)
            elif DRONE.is_dir():
                drone(work)


if __name__ == "__main__":
    main()
