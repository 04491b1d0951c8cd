"""Input of a run: photos or frames, their cameras, readout times, gyroscopes, and the pairs to match."""

from .gyroscope import GyroOptions

__all__ = ["GyroOptions"]
