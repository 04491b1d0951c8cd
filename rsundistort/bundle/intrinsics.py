"""Which intrinsics of a camera an adjustment refines, and what a step does to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..errors import InputError
from ..model import Camera
from ..model.array_types import Array

__all__ = [
    "DECENTRING",
    "INTRINSICS",
    "GuessedCameras",
    "check_lenses",
    "check_refined",
    "deviation",
    "moved_camera",
    "pixels_of",
    "prior_weight",
]

#: Intrinsics that can be refined and their codes in the kernels: `f` keeps the ratio of fx and fy.
INTRINSICS: dict[str, int] = {
    name: code for code, name in enumerate(("f", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4"))
}

# of the lens coefficients: OpenCV's k4 of a pinhole lens divides
_OF_LENS = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}


#: Errors of a calibration that look like a phi3 of all photos, of readout by rows and by columns.
DECENTRING: tuple[Mapping[str, float], ...] = ({"cx": 3.0, "p2": 1.0}, {"cy": 3.0, "p1": 1.0})


@dataclass(frozen=True)
class GuessedCameras:
    """Prior on the intrinsics that are refined, from what is known of the cameras before the photos.

    Its tails are heavy (`prior_weight`): a calibration that the photos contradict by many standard deviations yields to
    them.

    Parameters
    ----------
    cameras : sequence of Camera
        Guesses, one for each camera of the reconstruction.
    sigma : mapping of intrinsic to float, or a sequence of them
        Standard deviations, of all cameras or of each: of f (fx, fy) relative, of cx and cy in focal lengths, of the
        lens coefficients. Intrinsics that are not named have no prior.
    decentring : sequence of (float, float), optional
        Of each camera, the standard deviations e of an error of (cx, p2) = (3, 1) e and of (cy, p1) = (3, 1) e, which
        calibrations have beside that (`bundle.doubt`). It counts for the standard deviations that are
        reported; the estimate takes it for zero.
    """

    cameras: Sequence[Camera]
    sigma: Mapping[str, float] | Sequence[Mapping[str, float]]
    decentring: Sequence[tuple[float, float]] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.sigma, Mapping) and len(self.sigma) != len(self.cameras):
            raise InputError(f"{len(self.cameras)} guessed cameras and the sigmas of {len(self.sigma)}")
        if len(self.decentring) not in (0, len(self.cameras)):
            raise InputError(f"{len(self.cameras)} guessed cameras and the decentring of {len(self.decentring)}")
        stated = [self.sigma] if isinstance(self.sigma, Mapping) else self.sigma
        for name, value in (each for sigma in stated for each in sigma.items()):
            if name not in INTRINSICS or not 0 < value < np.inf:
                raise InputError(f"guessed {name!r}: sigma {value!r}, expected a positive one of an intrinsic")
        for value in (each for of_camera in self.decentring for each in of_camera):
            if not 0 <= value < np.inf:
                raise InputError(f"guessed decentring: sigma {value!r}, expected zero or a positive number")

    @property
    def sigmas(self) -> Sequence[Mapping[str, float]]:
        """The standard deviations of each camera."""
        return [self.sigma] * len(self.cameras) if isinstance(self.sigma, Mapping) else self.sigma

    def pulls_of_decentring(self, cameras: Sequence[Camera], names: Sequence[str], heavy: bool) -> Array:
        """(2, cameras, len(names)) by how much one standard deviation of it changes the prior's gradient at `cameras`.

        `heavy` says whether the prior is that of `prior_weight`, or normal. Then a calibration whose tangential terms
        the photos contradict is believed less here too: errors of how a lens is centred have a scale in common, as
        those of a Student's t distribution, and given n of them whose squares sum to d^2 that is (nu + d^2) / (nu + n)
        in the square (Ding, "On the conditional distribution of the multivariate t distribution", 2016). A focal length
        or a radial term that is missing says nothing of it.
        """
        pulls = np.zeros((2, len(cameras), len(names)))
        for k, (of_axes, camera, guess, of) in enumerate(
            zip(self.decentring, cameras, self.cameras, self.sigmas, strict=False)
        ):
            sigma = np.array([of.get(name, np.inf) for name in names])
            apart, slope = np.array(deviation(camera, guess, names)) / sigma
            weight = prior_weight(apart**2)[1] if heavy else np.ones(len(names))
            tangential = np.isin(names, ("p1", "p2")) & np.isfinite(sigma)
            scale = (_TAIL + (apart[tangential] ** 2).sum()) / (_TAIL + tangential.sum()) if heavy else 1.0
            for axis, (error, terms) in enumerate(zip(of_axes, DECENTRING, strict=True)):
                errors = error * max(scale, 1.0) ** 0.5 * np.array([terms.get(name, 0.0) for name in names])
                pulls[axis, k] = slope * weight * errors / sigma
        return pulls

    def surprises(self, cameras: Sequence[Camera]) -> list[tuple[int, str, float]]:
        """Intrinsics that lie more than three standard deviations off: (camera, name, how many)."""
        found = []
        for k, (camera, guess, sigma) in enumerate(zip(cameras, self.cameras, self.sigmas, strict=True)):
            names = [name for name in sigma if name in ("f", "fx", "fy", "cx", "cy") or name in camera.coefficients]
            for name, apart in zip(names, deviation(camera, guess, names)[0].tolist(), strict=True):
                if abs(apart) > 3.0 * sigma[name]:
                    found.append((k, name, abs(apart) / sigma[name]))
        return found


# Square of the deviation where the priors on intrinsics become robust: normal near the middle, but large deviations
# pull no harder than three standard deviations.
_TAIL = 9.0


def prior_weight(square: Array) -> tuple[Array, Array]:
    """Costs of squared deviations in units of sigma under a prior with heavy tails (Cauchy's loss), and weights."""
    return 0.5 * _TAIL * np.log1p(square / _TAIL), 1.0 / (1.0 + square / _TAIL)


def check_refined(names: Sequence[str]) -> tuple[str, ...]:
    """The names, refused if one is unknown, named twice, or contradicts another."""
    names = tuple(names)
    for name in names:
        if name not in INTRINSICS:
            raise InputError(f"cannot refine {name!r}, expected some of {', '.join(INTRINSICS)}")
    if len(set(names)) != len(names):
        raise InputError(f"intrinsics to refine are named twice: {', '.join(names)}")
    if "f" in names and {"fx", "fy"} & set(names):
        raise InputError("refine either f, which keeps the ratio of fx and fy, or fx and fy")
    return names


def check_lenses(names: Sequence[str], cameras: Sequence[Camera], what: str = "cannot refine") -> None:
    """Refuse names that are checked, but that the lenses of all cameras lack."""
    lenses = sorted({camera.lens for camera in cameras})
    known = [name for lens in lenses for name in _OF_LENS[lens]]
    for name in names:
        if INTRINSICS[name] >= INTRINSICS["k1"] and name not in known:
            raise InputError(f"{what} {name} of a {' or '.join(lenses)} lens, expected some of {', '.join(known)}")


def has_intrinsic(camera: Camera, name: str) -> bool:
    """Whether the camera's lens model has this one."""
    return INTRINSICS[name] < INTRINSICS["k1"] or name in _OF_LENS[camera.lens]


def moved_camera(camera: Camera, names: Sequence[str], step: Array) -> Camera:
    """The camera after a step (len(names),): of log f, of cx / fx and cy / fy, and of the lens coefficients."""
    K, lens = np.array(camera.K), camera.coefficients
    # a step of e^10 is as astray as any
    for name, value in zip(names, np.clip(step, -10, 10), strict=True):
        if name in ("f", "fx"):
            K[0, 0] *= np.exp(value)
        if name in ("f", "fy"):
            K[1, 1] *= np.exp(value)
        if name == "cx":
            K[0, 2] += camera.K[0, 0] * value
        if name == "cy":
            K[1, 2] += camera.K[1, 1] * value
        if name in _OF_LENS[camera.lens]:
            lens[name] += value
    dist = np.array(list(lens.values())[: max(len(camera.dist), 5 if "k3" in names else 4)])
    return replace(camera, K=K, dist=dist if dist.any() else camera.dist)


def deviation(camera: Camera, guess: Camera, names: Sequence[str]) -> tuple[Array, Array]:
    """How far (len(names),) a camera is from a guess, in the units of `GuessedCameras`; derivatives in the unknowns."""
    fx, fy, cx, cy = camera.kernel_args[0]
    gx, gy, gcx, gcy = guess.kernel_args[0]
    apart = {"f": np.log(fx / gx), "fx": np.log(fx / gx), "fy": np.log(fy / gy), "cx": (cx - gcx) / gx}
    apart["cy"] = (cy - gcy) / gy
    slope = {"cx": fx / gx, "cy": fy / gy}
    guessed = guess.coefficients
    apart |= {name: value - guessed[name] for name, value in camera.coefficients.items()}
    # a lens lacks some coefficients of another
    return np.array([apart.get(name, 0.0) for name in names]), np.array([slope.get(name, 1.0) for name in names])


def pixels_of(camera: Camera, names: Sequence[str]) -> Array:
    """(len(names),) pixels (or coefficients) that a unit of each unknown stands for."""
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    return np.array([{"f": fx, "fx": fx, "fy": fy, "cx": fx, "cy": fy}.get(name, 1.0) for name in names])
