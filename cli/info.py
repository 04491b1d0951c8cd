"""`rsundistort info`."""

from __future__ import annotations

import click

from .terminal import errors_for_people, table


@click.command()
def command() -> None:
    """Versions, threads and optional parts."""
    with errors_for_people():
        import cv2

        from rsundistort.pipeline import use_threads, versions

        rows = [(name, number) for name, number in versions().items()]
        rows.append(("threads", str(use_threads(0))))
        keeps = "kept" if hasattr(cv2, "imdecodeWithMetadata") else "lost (needs OpenCV 5)"
        rows.append(("EXIF, XMP, ICC of JPEG, PNG, WebP", keeps))
    click.echo(table(rows))
