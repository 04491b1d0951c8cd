"""Where the tracks of a run come from: features as the photos were taken, of other kinds, and without motions."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

from ..batch.progress import StageLog
from ..batch.workers import Workers
from ..input.load import LoadedPhotos, OtherFeatures
from ..input.motion_search import search_motions
from ..io.kept import Kept
from ..model import Reconstruction
from ..model.array_types import Array
from ..sfm import MatchedPhotos
from .placing import match_without_motions, place_photos
from .tracks import TrackSource

__all__ = ["TrackSources"]


@dataclass(frozen=True)
class TrackSources:
    """Sources of tracks of the photos of a run.

    Attributes
    ----------
    scratch : Path
        Folder for databases.
    seed, matching, workers, other, always_affine
        As in `solve_photos`.
    """

    photos: LoadedPhotos
    scratch: Path
    seed: int
    log: StageLog
    matching: str
    kept: Kept
    workers: Workers | None
    other: OtherFeatures | None
    always_affine: bool = False
    # photos of which a search found no motion, and in how large a scene at most
    _unfound: dict[str, int] = field(init=False, default_factory=dict)

    def mapped(self) -> tuple[Reconstruction, TrackSource]:
        """A mapping of the photos as they were taken, and the source of its tracks."""
        mapped, matched = self._placed(self.photos, self.scratch, other=self.other)
        of_affine = None if self.other is None else cache(self._of_affine)
        return mapped, replace(self._source_of(matched), of_affine=of_affine, always_affine=self.always_affine)

    def _of_affine(self, is_strong: bool) -> tuple[Reconstruction, TrackSource]:
        """A mapping with features beside the usual ones that a strong shutter leaves as they are."""
        assert self.other is not None
        folder = self.scratch / "affine"
        folder.mkdir()
        mapped, matched = self._placed(self.other.affine(), folder, is_strong=is_strong)
        return mapped, replace(self._source_of(matched), without_motions=partial(self._without_motions, matched))

    def _without_motions(self, before: MatchedPhotos, rec: Reconstruction) -> TrackSource:
        """Features of the photos of a reconstruction without the motions that it found."""
        return self._without(before, rec, dict(zip(rec.image_names, rec.phi, strict=True)), {})

    def _with_found_motions(self, before: MatchedPhotos, scene: Reconstruction, phi_sigma: float) -> TrackSource | None:
        """Features of photos that a scene lacks without motions that a search finds; None if it finds none."""
        assert self.other is not None
        size = scene.num_images
        phi = search_motions(
            self.photos, before, scene, self.other.megapixels, self.other.workers, self.log, phi_sigma=phi_sigma,
            passed_over=[name for name, largest in self._unfound.items() if size <= largest],
        )  # fmt: skip
        for name in {*self.photos.names}.difference(scene.image_names, phi):
            self._unfound[name] = max(size, self._unfound.get(name, 0))
        return self._without(before, scene, phi, phi) if phi else None

    def _without(
        self, before: MatchedPhotos, rec: Reconstruction, phi: Mapping[str, Array], rough_phi: Mapping[str, Array]
    ) -> TrackSource:
        """Features of some photos without their motions phi, beside those that the others had before."""
        assert self.other is not None
        own = {name: rec.cameras[k] for name, k in self.photos.camera_of.items()}
        own |= {name: rec.camera(i) for i, name in enumerate(rec.image_names)}
        loaded = self.other.without_motions(own, phi, before.features)
        folder = Path(tempfile.mkdtemp(prefix="without-motions-", dir=self.scratch))
        found = match_without_motions(loaded, rec, folder, self.log, self.seed, self.matching, rough_phi)
        return replace(self._source_of(found), rough_phi=rough_phi)

    def _placed(
        self, photos: LoadedPhotos, folder: Path, other: OtherFeatures | None = None, *, is_strong: bool = False
    ) -> tuple[Reconstruction, MatchedPhotos]:
        return place_photos(
            photos, folder, self.log, self.seed, self.matching, self.kept, with_shutter=True, is_strong=is_strong,
            other=other,
        )  # fmt: skip

    def _source_of(self, matched: MatchedPhotos) -> TrackSource:
        find = None if self.other is None else self._with_found_motions
        return TrackSource(matched, self.photos, self.workers, mapped_here=True, with_found_motions=find)
