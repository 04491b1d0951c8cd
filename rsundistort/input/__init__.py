"""What a run is given: photos or frames, their cameras, times of readout, gyroscopes, and which photos to pair."""

from .gyroscope import GyroOptions

__all__ = ["GyroOptions"]
