"""Help of commands with many options: under headings, those that a first run needs on top."""

from __future__ import annotations

import click

__all__ = ["SECTIONS", "Sectioned"]

_LAST = "Work and messages"

#: Headings of the help and the options under each, by the name of the parameter.
SECTIONS: dict[str, tuple[str, ...]] = {
    "Options for a first run": ("solution", "out", "camera", "images", "readout", "masks", "overwrite"),
    "Video and gyroscope": (
        "frames", "every", "sharpest", "gyro", "gyro_offset", "gyro_axes", "photo_times", "readout_ms",
    ),
    "Features and matching": ("max_features", "feature_megapixels", "features", "matching", "database"),
    "Camera and motion": ("shutter_model", "refine", "camera_sigma", "still", "known", "remedy"),
    "Survey": ("crs", "control", "lengths"),
    "Rectified photos": (
        "depth", "alpha", "scale", "max_size", "interpolation", "quality", "raw_as", "apply_orientation", "again",
        "max_megapixels", "also",
    ),
    "More outputs": ("exports", "rs_poses", "usd", "maps", "sparse_format", "report"),
    _LAST: (
        "resume", "jobs", "scheduler", "seed", "progress_form", "as_json", "quiet", "verbose",
    ),
}  # fmt: skip


class Sectioned(click.Command):
    """A command that lists its options under the headings of `SECTIONS`."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write each heading with the options that the command has of it."""
        options = [each for each in self.get_params(ctx) if isinstance(each, click.Option)]
        records = {str(each.name): each.get_help_record(ctx) for each in options}
        listed = {name for names in SECTIONS.values() for name in names}
        others = tuple(name for name in records if name not in listed)  # --help
        for heading, names in {**SECTIONS, _LAST: SECTIONS[_LAST] + others}.items():
            if rows := [row for name in names if (row := records.get(name)) is not None]:
                with formatter.section(heading):
                    formatter.write_dl(rows)
