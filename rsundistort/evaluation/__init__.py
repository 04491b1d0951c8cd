"""Comparison of solutions and images with the truth."""

from .metrics import MotionErrors, PoseErrors, motion_errors, pose_errors, psnr

__all__ = ["MotionErrors", "PoseErrors", "motion_errors", "pose_errors", "psnr"]
