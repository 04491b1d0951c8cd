"""The motion of the camera while its shutter runs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..errors import InputError
from .array_types import Array
from .bend import Bend, bend_table, parts_of
from .camera import check_readout
from .checks import check_finite, check_kind, check_number, check_numbers, check_one_of, check_rotation, frozen
from .values import ComparedByFields

__all__ = ["SHUTTER_MODELS", "RowMotion", "check_shutter_model", "steady_parts"]

#: Names of the shutter models and their codes in the kernels, in the order of the model sequence.
SHUTTER_MODELS: dict[str, int] = {"global": 0, "two-step": 1, "linearized": 2, "rotation": 3, "constant-motion": 4}


_FRAMES = ("world", "camera")
# Radians during the readout of one focal length: far beyond a fast rotation with the longest lens.
_FASTEST = 1000.0


def check_shutter_model(name: str) -> int:
    """The code of a shutter model in the kernels."""
    if not isinstance(name, str) or name not in SHUTTER_MODELS:
        raise InputError(f"shutter model {name!r}, expected one of {', '.join(SHUTTER_MODELS)}")
    return SHUTTER_MODELS[name]


def steady_parts(clock: Array, moved: Array, sites: int) -> tuple[Array, Array, Array, Array]:
    """`RowMotion.of` for k frames at once.

    Parameters
    ----------
    clock : (n,) array
        Ascending, from the start of the frames to their end.
    moved : (k, n, 6) array
        Rotation vectors and positions there relative to some poses.
    sites : int
        Values of the bends.

    Returns
    -------
    bend : (k, sites, 6) array
        Beside the nearest steady motions.
    correction, way : (k, 3, 3), (k, 3) array
        The poses that go with these have rotations `correction R_cw` and centres `center_w + way`.
    rate : (k, 2, 3) array
        Phi and velocity.
    """
    k, n = moved.shape[:2]
    readings = Rotation.from_rotvec(moved[..., :3].reshape(-1, 3)).as_matrix().reshape(k, n, 3, 3)
    correction = readings[:, n // 2]
    # the constant part goes into the pose; rotations do not commute, so that a share of it is left each time
    for _ in range(10):
        left = Rotation.from_matrix(
            (readings @ correction[:, None].transpose(0, 1, 3, 2)).reshape(-1, 3, 3)
        ).as_rotvec()
        both = np.concatenate([left.reshape(k, n, 3), moved[..., 3:]], axis=2)
        rest, constant, rate = parts_of(clock, both.transpose(1, 0, 2).reshape(n, -1), sites)
        constant = constant.reshape(k, 2, 3)
        correction = Rotation.from_rotvec(constant[:, 0]).as_matrix() @ correction
        if np.abs(constant[:, 0]).max(initial=0.0) < 1e-15:
            break
    return rest.reshape(sites, k, 6).transpose(1, 0, 2), correction, constant[:, 1], rate.reshape(k, 2, 3)


@dataclass(frozen=True, eq=False)
class RowMotion(ComparedByFields):
    """Motion during the readout, per unit of the clock r (r is 0 at the principal row).

    Parameters
    ----------
    phi : (3,) array
        Rotation in radians per unit of r, in the camera frame (the paper's phi).
    velocity : (3,) array
        World units per unit of r (the paper's v).
    bend : Bend, optional
        How the motion deviates from this steady one; used by the rotation and constant-motion models. The pose that
        belongs to it is then that of the nearest steady motion at r = 0, not the pose at that moment.
    frame : {"world", "camera"}, optional
        Frame of the velocity and of the bend's positions. A `SolvedImage` has its motion in the world; projection and
        rectification take it in the camera (`in_camera`), and refuse one in the other frame.

    Examples
    --------
    >>> RowMotion([0.1, 0.02, 0.0]).imaginary_camera()
    (0.9, 0.02)
    """

    phi: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    bend: Bend | None = None
    frame: str | None = None

    def __post_init__(self) -> None:
        if self.frame is not None:
            check_one_of(self.frame, _FRAMES, "frame")
        for name in ("phi", "velocity"):
            object.__setattr__(self, name, frozen(check_finite(getattr(self, name), (3,), name)))
        if np.abs(self.phi).max() > _FASTEST:
            raise InputError(
                f"phi={self.phi.tolist()}: no camera rotates by more than {_FASTEST:g} rad per focal length"
            )
        if self.bend is not None:
            check_kind(self.bend, Bend, "bend")

    @classmethod
    def of(
        cls, clock: ArrayLike, rotation: ArrayLike, position: ArrayLike | None = None, sites: int = 65
    ) -> tuple[RowMotion, Array, Array]:
        """The motion through given poses, and the pose that it belongs to.

        Parameters
        ----------
        clock : (k,) array
            Ascending, from the start of the frame to its end.
        rotation, position : (k, 3) array
            Rotation vectors and positions there relative to some pose: `Exp(rotation) R_cw` and `center_w + position`.
        sites : int
            Values of the bend, the cubic spline that remains beside the nearest steady motion.

        Returns
        -------
        motion : RowMotion
            Its bend is orthogonal to 1 and to the clock.
        correction : (3, 3) array
            The pose that goes with it has the rotation `correction R_cw`
        way : (3,) array
            and the centre `center_w + way`.
        """
        readings = Rotation.from_rotvec(np.array(check_finite(rotation, (None, 3), "rotation")))
        correction = readings[len(readings) // 2]
        # the constant part goes into the pose; rotations do not commute, so that a share of it is left each time
        for _ in range(50):
            bend, constant, rate = Bend.of(clock, (readings * correction.inv()).as_rotvec(), position, sites)
            correction = Rotation.from_rotvec(constant[0]) * correction
            if np.abs(constant[0]).max() < 1e-15:
                break
        return cls(rate[0], rate[1], bend), correction.as_matrix(), constant[1]

    def steady(self, start: float, end: float) -> tuple[RowMotion, Array, Array]:
        """The nearest steady motion while the clock runs from start to end, and the pose it belongs to.

        As `of` returns them, without a bend: of least mean square in rotation and in position.
        """
        if self.bend is None:
            return self, np.eye(3), np.zeros(3)
        clock = np.linspace(start, end, 1025)
        near, correction, way = RowMotion.of(clock, *self.at(clock), sites=len(self.bend.values))
        return replace(near, bend=None, frame=self.frame), correction, way

    def in_camera(self, R_cw: Array) -> RowMotion:
        """The motion with its velocity in the camera frame at the reference row, as projection takes it."""
        self._check_frame("world")
        R = check_rotation(R_cw, "R_cw")
        bend = None if self.bend is None else self.bend.rotated(np.eye(3), R)
        return replace(self, velocity=R @ self.velocity, bend=bend, frame="camera")

    def as_in(self, frame: str) -> RowMotion:
        """The motion, declared to be in a frame; refused if it is declared to be in the other, and travels."""
        self._check_frame(frame)
        return replace(self, frame=frame)

    def _check_frame(self, frame: str) -> None:
        """Refuse a motion that is declared to be in the other frame, if the camera travels."""
        if self.frame is not None and self.frame != frame and self.moves:
            mend = "" if frame == "world" else "; call motion.in_camera(R_cw)"
            raise InputError(f"the motion is in the {self.frame} frame, expected the {frame} frame{mend}")

    @property
    def velocity_in_camera(self) -> Array:
        """The velocity for the kernels, of a motion that is not declared to be in the world."""
        self._check_frame("camera")
        return self.velocity.copy()

    @property
    def moves(self) -> bool:
        """Whether the camera travels, and does not only rotate."""
        return bool(self.velocity.any()) or (self.bend is not None and self.bend.moves)

    @cached_property
    def kernel_phi(self) -> Array:
        """Phi for the kernels, (3,), or the table of a motion with a bend.

        Arrays are writable, as the adjustment's are: kernels are compiled for each kind of array that they meet.
        """
        if self.bend is None:
            return self.phi.copy()
        return bend_table(self.phi, self.bend.start, self.bend.end, self.bend.values)

    def at(self, clock: ArrayLike) -> tuple[Array, Array]:
        """Rotation vector and position (..., 3) relative to the pose at the clock r (...), for exact models."""
        r = check_numbers(clock, "clock")
        with np.errstate(invalid="ignore"):  # at no moment: NaN
            rotation, way = r[..., None] * self.phi, r[..., None] * self.velocity
        if self.bend is not None:
            bent, moved = self.bend.at(r)
            rotation, way = rotation + bent, way + moved
        return rotation, way

    def pose_at(self, clock: float, R_cw: Array, center_w: Array) -> tuple[Array, Array]:
        """Pose when the clock shows r, exact for the rotation and constant-motion models (paper Eq. 2).

        Parameters
        ----------
        clock : float
            r, as `clock_of` gives it of a pixel.
        R_cw, center_w : (3, 3), (3,) array
            Pose that the motion belongs to, without a bend that at r = 0. The velocity is in the world here.

        Returns
        -------
        R_cw, center_w : (3, 3), (3,) array
            Exp(r phi) R_cw, and the centre moved by r velocity, with what the bend adds.
        """
        self._check_frame("world")
        rotation, way = self.at(check_number(clock, "clock"))
        R, center = check_rotation(R_cw, "R_cw"), check_finite(center_w, (3,), "center_w")
        return Rotation.from_rotvec(rotation).as_matrix() @ R, center + way

    def imaginary_camera(self, readout: str = "top-to-bottom") -> tuple[float, float]:
        """Aspect ratio and skew, in the readout direction, of the imaginary camera of the paper."""
        axis, sign = check_readout(readout)
        # for columns x and y are exchanged, which takes phi to -(phi2, phi1, phi3)
        phi = sign * (self.phi if axis == 1 else -self.phi[[1, 0, 2]])
        return 1.0 - float(phi[0]), float(phi[1])
