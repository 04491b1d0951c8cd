"""Matches of descriptors by words: how many of the exact ones, and the time, beside pycolmap's fast matcher.

    python benchmarks/matching.py [--photos DIR] [--sets SET ...] [--runs N]

Prints one JSON object a set: photos, pairs and exact matches (all descriptors compared with all, as pycolmap's
brute-force matcher does); for the words and for pycolmap's fast matcher (FAISS) the share of the exact matches that is
missing and of others that are found besides, and processor seconds a pair; and of pycolmap, how many of --runs (3) runs
had other matches than the first. Geometric verification is left out.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from rsundistort.batch.progress import StageLog
from rsundistort.batch.workers import Workers
from rsundistort.colmap.conventions import quiet_pycolmap
from rsundistort.input.load import LoadedPhotos, load_photos
from rsundistort.sfm import MatchedPhotos
from rsundistort.sfm.codebook import make_codebook
from rsundistort.sfm.database import write_photos
from rsundistort.sfm.descriptor_matches import DescriptorIndex, match_descriptors

PHOTOS = Path(__file__).resolve().parents[2] / "shared" / "photos"

Matches = dict[tuple[int, int], set[tuple[int, int]]]


def ours(photos: LoadedPhotos, by_words: bool) -> Matches:
    """Matches of all pairs; without words all descriptors are compared."""
    descriptors = [each.descriptors for each in photos.features]
    words = make_codebook(descriptors, 0) if by_words else None
    indices = [DescriptorIndex.of(each, words) for each in descriptors]
    return {
        (i, j): {(int(a), int(b)) for a, b in match_descriptors(indices[i], indices[j])}
        for i, j in combinations(range(len(indices)), 2)
    }


def theirs(photos: LoadedPhotos) -> Matches:
    """The same by pycolmap."""
    pycolmap = quiet_pycolmap()
    options, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    options.use_gpu, options.skip_geometric_verification, verification.min_num_inliers = False, True, 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "database.db"
        cameras = photos.cameras
        with pycolmap.Database.open(path) as db:
            write_photos(
                db, MatchedPhotos(path, photos.names, photos.features, cameras.cameras, cameras.camera_idx, True, 0)
            )
            for index, each in enumerate(photos.features):
                sift = pycolmap.FeatureExtractorType.SIFT
                db.write_descriptors(index + 1, pycolmap.FeatureDescriptors(type=sift, data=each.descriptors))
        pycolmap.match_exhaustive(path, options, verification_options=verification, device=pycolmap.Device.cpu)
        with pycolmap.Database.open(path) as db:
            return {
                (i, j): {(int(a), int(b)) for a, b in np.asarray(db.read_matches(i + 1, j + 1))}
                for i, j in combinations(range(len(photos.names)), 2)
            }


def timed(function: Callable[..., Matches], *args: Any) -> tuple[Matches, float]:
    """What a function returns, and its processor seconds a pair."""
    start = time.process_time()
    found = function(*args)
    return found, (time.process_time() - start) / len(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, default=PHOTOS)
    parser.add_argument("--sets", nargs="*", default=["herz-jesus-8", "drone"])
    parser.add_argument("--runs", type=int, default=3)
    args = parser.parse_args()
    for name in args.sets:
        photos = load_photos(args.photos / name, None, None, 8192, Workers(0), StageLog(None))
        ours(photos, True)  # the kernel is compiled
        exact, of_exact = timed(ours, photos, False)
        count = sum(map(len, exact.values()))
        said: dict[str, Any] = {"set": name, "photos": len(photos.names), "pairs": len(exact), "exact": count}
        said["exact_s"] = round(of_exact, 4)
        runs = [theirs(photos) for _ in range(args.runs - 1)]
        for label, (found, seconds) in (("words", timed(ours, photos, True)), ("pycolmap", timed(theirs, photos))):
            missing = sum(len(exact[pair] - found[pair]) for pair in exact)
            besides = sum(len(found[pair] - exact[pair]) for pair in exact)
            said |= {f"{label}_missing": round(missing / count, 4), f"{label}_besides": round(besides / count, 4)}
            said[f"{label}_s"] = round(seconds, 4)
        print(json.dumps(said | {"pycolmap_differs": sum(each != found for each in runs)}), flush=True)


if __name__ == "__main__":
    main()
