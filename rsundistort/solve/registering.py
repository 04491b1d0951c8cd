"""Photos that mapping left out or gave a wrong pose, registered once their motions are known."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ..batch.progress import StageLog
from ..bundle import BundleOptions, BundleResult
from ..errors import InputError, ReconstructionError, RsUndistortWarning
from ..model import Reconstruction
from ..model.array_types import Mask
from ..sfm import (
    LEAST_MEASUREMENTS,
    carried_along,
    contradicting_photos,
    firmly_connected,
    map_without_motions,
    photos_beside_breaks,
    read_num_verified,
    register_photos,
    retriangulate,
)
from ..sfm.registration import Registration
from .solutions import agree, num_explained, photos_apart, same_places
from .tracks import (
    LEAST_PHOTOS,
    TrackSource,
    adjusted_sequence,
    is_strong,
    of_registered,
    rough_options,
    roughly_adjusted,
    tell,
)

__all__ = ["Registrar", "warn_of_left_out"]

# Rounds of registration: photos that are registered make others possible.
_MOST_WAVES = 4
# Models with motions that poses without a shutter may be wrong by.
_MODELS = "rotation", "constant-motion"


def warn_of_left_out(names: Collection[str]) -> None:
    """Say which photos are left out, since they contradict the others."""
    if names:
        warnings.warn(
            f"left out, since they contradict the other photos: {', '.join(sorted(names))}",
            RsUndistortWarning, stacklevel=4,
        )  # fmt: skip


@dataclass
class _LostPlaces:
    """Photos that lost their places, and the reconstruction that they were in before."""

    former: Reconstruction | None = None
    names: set[str] = field(default_factory=set)

    def note(self, former: Reconstruction, names: Collection[str]) -> None:
        """Add some, which were in this reconstruction if they are the first."""
        self.former = self.former or former
        self.names.update(names)

    def carried_along(self, found: Registration) -> Registration:
        """With those that photos of their side, which were placed again, carry along.

        Once: if they contradict the others again, they stay left out.
        """
        if self.former is None:
            return found
        scene, former, self.former = found.reconstruction, self.former, None
        more = carried_along(scene, former, self.names)
        return replace(found, reconstruction=more, added=tuple(more.image_names[scene.num_images :]))


@dataclass(frozen=True)
class Registrar:
    """Registers the photos of a source of tracks.

    Attributes
    ----------
    track_source : TrackSource
        Matches, as mapping used them: new tracks overwrite how many of them a free geometry fits.
    wanted : BundleOptions
        Of the adjustments, with the constraints of all photos.
    """

    track_source: TrackSource
    wanted: BundleOptions
    log: StageLog
    _num_verified: dict[tuple[int, int], int] = field(init=False)
    # photos of the solution at hand that points of the others place where they are, whatever the matches say
    _confirmed: set[str] = field(init=False, default_factory=set)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_num_verified", read_num_verified(self.track_source.matched))

    def all_registered(self, result: BundleResult, *, again: bool) -> tuple[BundleResult, set[str]]:
        """The solution with as many photos as can be registered; `again` by a second mapping, whose frame is another.

        With it come those that are left out, since they contradict the others. A second mapping takes a shutter that is
        strong, or was before photos lost their poses, or photos that may have a wrong place.
        """
        if result.reconstruction.shutter_model not in _MODELS:
            return result, set()
        strong, before = is_strong(result.reconstruction), result
        result, left_out = self._registered(result)
        if self._is_worse(result.reconstruction, before.reconstruction):
            result, left_out = before, set()
        strong = strong or is_strong(result.reconstruction)
        again = again and self.track_source.mapped_here
        if again and (strong or left_out or self._suspects(result.reconstruction).any()):
            result, left_out = self._mapped_again(result, left_out)
        return result, left_out

    def _is_worse(self, new: Reconstruction, old: Reconstruction) -> bool:
        """Whether the same photos explain fewer measurements in new places: then these are wrong, and not the old.

        Beside a break of the scale each side has points of its own, and these fit better than common ones.
        """
        if {*new.image_names} != {*old.image_names} or new is old:
            return False
        tracks, former = self._new_tracks(new), self._new_tracks(old)
        if self._breaks(former).any() and not self._breaks(tracks).any():
            return False
        return num_explained(tracks) < num_explained(former)

    def without_motions(self, result: BundleResult, left_out: set[str]) -> tuple[Registrar, BundleResult, set[str]]:
        """The best solution by features of photos without motions, if these are strong.

        First without the motions found, if it explains more; then also without motions that other photos may have,
        which match nothing as they were taken, or by which they contradict their places, if more photos are right.
        """
        if not is_strong(result.reconstruction):
            return self, result, left_out
        best, detect = self, self.track_source.without_motions
        if detect is not None:
            best, result, left_out = self.with_features(detect(result.reconstruction), result, left_out)
        return best._with_found_motions(result, left_out)

    def _with_found_motions(self, result: BundleResult, left_out: set[str]) -> tuple[Registrar, BundleResult, set[str]]:
        matched, find = self.track_source.matched, self.track_source.with_found_motions
        if find is None:
            return self, result, left_out
        suspects = self.suspects(result.reconstruction)
        num_right = result.reconstruction.num_images - len(suspects)
        if num_right == len(matched.names):
            return self, result, left_out
        scene = self._new_tracks(result.reconstruction)
        scene = scene.take_photos(~np.isin(scene.image_names, suspects))
        source = find(matched, scene, result.phi_rms) if scene.num_images >= LEAST_PHOTOS else None
        if source is None:
            return self, result, left_out
        best, found, found_left_out = self.with_features(source, result, left_out)
        if found.reconstruction.num_images - len(best.suspects(found.reconstruction)) <= num_right:
            return self, result, left_out
        # what they show may be what others lacked
        return best._with_found_motions(found, found_left_out)

    def with_features(
        self, source: TrackSource, result: BundleResult, left_out: set[str]
    ) -> tuple[Registrar, BundleResult, set[str]]:
        """The solution by other features of its photos, if these explain more measurements, and as many photos."""
        other = Registrar(source, self.wanted, self.log)
        try:
            found, found_left_out = other.all_registered(result, again=False)
        except (ReconstructionError, InputError):
            return self, result, left_out
        more, fewer = other._new_tracks(found.reconstruction), self._new_tracks(result.reconstruction)
        if more.num_images < fewer.num_images or num_explained(more) <= num_explained(fewer):
            return self, result, left_out
        return other, found, found_left_out

    def suspects(self, reconstruction: Reconstruction) -> list[str]:
        """Photos that may have a wrong place, since matches with the others contradict it."""
        # measurements that were aligned are no keypoints any more
        tracks = self._new_tracks(reconstruction)
        if not tracks.num_images:
            return list(reconstruction.image_names)
        beside = np.array(tracks.image_names)[self._breaks(tracks)]
        suspect = np.isin(reconstruction.image_names, [*set(beside.tolist()) - self._confirmed])
        suspect |= self._suspects(reconstruction)
        return [reconstruction.image_names[i] for i in np.flatnonzero(suspect).tolist()]

    def _registered(self, result: BundleResult) -> tuple[BundleResult, set[str]]:
        """Register photos that mapping left out, or gave a wrong pose without a shutter, with the points of the others.

        With it come those that lost their poses, since they contradict the others.
        """
        matched, left_out, lost = self.track_source.matched, set[str](), _LostPlaces()
        for wave in range(1, _MOST_WAVES + 1):
            before, rec = result, result.reconstruction
            strong, all_placed = is_strong(rec), rec.num_images == len(matched.names)
            suspect = self._suspects(rec).any()
            if not strong and all_placed and not suspect:
                break
            stage = f"registration {wave}"
            self.log.begin(stage)
            scene = self._new_tracks(rec)
            if (strong or suspect) and wave == 1 and scene.num_images >= LEAST_PHOTOS:
                # thresholds without a shutter had cut off most measurements: no photo is judged before they are back,
                # nor is what connects it
                loose = retriangulate(matched, rec).without_photos(LEAST_MEASUREMENTS) if strong else scene
                result = self._adjusted(loose, result, stage)
                scene = self._new_tracks(result.reconstruction)
            if not scene.num_images:  # as a second mapping may leave them: there is nothing to register photos with
                self.log.end(stage, added=(), moved=(), dropped=())
                break
            if self._confirms(scene, strong, lost.names) and not strong:
                # a lens that moves contradicts as a wrong place does
                result, scene = before, self._new_tracks(before.reconstruction)
                if all_placed:
                    self.log.end(stage, added=(), moved=(), dropped=())
                    break
            wrong = self._contradicting(scene)
            taken = [scene.image_names[i] for i in np.flatnonzero(wrong).tolist()]
            whole = scene
            if taken:
                scene = firmly_connected(scene.take_photos(~wrong))
            rough_phi = self.track_source.rough_phi
            found = register_photos(matched, self._num_verified, scene, strong=strong, rough_phi=rough_phi)
            if gone := {*rec.image_names}.difference(scene.image_names).union(found.dropped):
                lost.note(whole if whole.num_images == rec.num_images else rec, gone)
            elif not found.changes and wave < _MOST_WAVES:  # the next one judges them
                found = lost.carried_along(found)
            changes = found.changes or scene.num_images < rec.num_images
            if changes:
                tracks = found.reconstruction
                if tracks.num_images >= LEAST_PHOTOS:
                    tracks = self._new_tracks(tracks)
                if tracks.num_images < LEAST_PHOTOS:  # too few are connected to distinguish right from wrong
                    self.log.end(stage, added=(), moved=(), dropped=())
                    break
                result = self._adjusted(tracks, result, stage)
            left_out = left_out.union(found.dropped, taken) - {*result.reconstruction.image_names}
            self.log.end(stage, added=found.added, moved=found.moved, dropped=(*taken, *found.dropped))
            if not changes:
                break
        return result, left_out

    def _mapped_again(self, result: BundleResult, left_out: set[str]) -> tuple[BundleResult, set[str]]:
        """The solution, or that of a mapping of keypoints without rough motions if that has more photos in their place.

        A side of a scene that mapping rotated as a whole has no photo that fits elsewhere. The cameras as they came and
        as they were found give two places to start from, and the motions of the photos that are right a third one,
        which shows those of the others. The other solution must explain more measurements even without those of photos
        that looked another way in the first one and were no suspects: nobody knows where these are wrong.
        """
        rec, matched = result.reconstruction, self.track_source.matched
        # photos that no tracks connect have no place
        firm = rec.take_photos(~self._suspects(rec) & np.isin(rec.image_names, self._new_tracks(rec).image_names))
        best, best_left_out, stage = result, left_out, "mapping without motions"
        confirmed = {*self._confirmed}
        for cameras_found, motions_known in ((False, False), (True, False), (True, True)):
            of_best, start, known_phi = best.reconstruction, matched, {}
            suspects = self._suspects(of_best)
            if of_best.num_images == len(matched.names) and not suspects.any():
                break
            if cameras_found:
                start = replace(matched, cameras=rec.cameras, calibrated=True)
            if motions_known:
                right = of_best.take_photos(~suspects)
                known_phi = dict(zip(right.image_names, right.phi, strict=True))
                start = replace(start, cameras=right.cameras)
            self.log.begin(stage)
            mapped = None
            with suppress(ReconstructionError, InputError):
                mapped = map_without_motions(start, result.phi_rms, known_phi)
            self.log.end(stage, photos=0 if mapped is None else mapped.num_images)
            if mapped is None or mapped.num_images < LEAST_PHOTOS:
                continue
            if motions_known:
                adjusted = self._adjusted(replace(mapped, shutter_model=rec.shutter_model), best, stage)
            else:
                options = rough_options(of_registered(self.wanted, mapped, says=False))
                adjusted = adjusted_sequence(mapped, rec.shutter_model, options, self.log)
            self._confirmed.clear()  # where photos are in one solution says nothing of the other
            other, other_left_out = self._registered(adjusted)
            new = other.reconstruction
            explained = num_explained(self._new_tracks(new), without=photos_apart(firm, new))
            if new.num_images > firm.num_images and explained > num_explained(self._new_tracks(of_best)):
                best, best_left_out, confirmed = other, other_left_out, {*self._confirmed}
            self._confirmed.clear()
            self._confirmed.update(confirmed)
        return best, best_left_out

    def _confirms(self, scene: Reconstruction, strong: bool, lost: Collection[str]) -> bool:
        """Whether suspects, registered again by the points of the others alone, come back to where they are.

        Those that lost their places before were registered in this way, and would come back wherever they are.
        """
        suspects = self._suspects(scene)
        if not suspects.any() or (~suspects).sum() < LEAST_PHOTOS:
            return False
        rest = scene.take_photos(~suspects)
        found = register_photos(self.track_source.matched, self._num_verified, rest, strong=strong)
        names = [scene.image_names[i] for i in np.flatnonzero(suspects).tolist() if scene.image_names[i] not in lost]
        again = [name for name in found.added if name in names]
        confirmed = bool(again) and agree(scene, found.reconstruction) and same_places(scene, found.reconstruction)
        if confirmed:
            self._confirmed.update(names)
        return confirmed

    def _suspects(self, reconstruction: Reconstruction) -> Mask:
        return self._contradicting(reconstruction, suspects=True)

    def _contradicting(self, reconstruction: Reconstruction, *, suspects: bool = False) -> Mask:
        matched = self.track_source.matched
        found = contradicting_photos(matched, self._num_verified, reconstruction, suspects=suspects)
        found |= self._breaks(reconstruction)
        return found & ~np.isin(reconstruction.image_names, [*self._confirmed])

    def _breaks(self, tracks: Reconstruction) -> Mask:
        return photos_beside_breaks(self.track_source.matched, tracks)

    def _new_tracks(self, reconstruction: Reconstruction) -> Reconstruction:
        """New tracks, and the photos that they connect: none if not one match agrees with the poses."""
        try:
            return firmly_connected(retriangulate(self.track_source.matched, reconstruction))
        except ReconstructionError:
            return reconstruction.take_photos(np.zeros(reconstruction.num_images, bool))

    def _adjusted(self, tracks: Reconstruction, result: BundleResult, stage: str) -> BundleResult:
        return roughly_adjusted(tracks, result, self.wanted, partial(tell, self.log, stage))
