"""Comparison of solutions and images with the truth."""

from .metrics import MotionErrors, PoseErrors, align_points, motion_errors, pose_errors, psnr, rotation_angles_deg

__all__ = ["MotionErrors", "PoseErrors", "align_points", "motion_errors", "pose_errors", "psnr", "rotation_angles_deg"]
