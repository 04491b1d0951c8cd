"""Tables that people write: CSV files with a header."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from ..errors import FileError, FormatError

__all__ = ["check_cells", "check_columns", "read_table"]


def check_columns(path: Path, columns: Sequence[str]) -> None:
    """Refuse two columns of one name, of which one would be taken; those without a name are not asked for."""
    if twice := [column for column in columns if column and columns.count(column) > 1]:
        raise FormatError(f"{path} has two columns {twice[0]!r}; remove one")


def check_cells(path: Path, line: int, num_columns: int, surplus: Sequence[str]) -> None:
    """Refuse cells of a line beyond the columns, as decimal commas make them; spreadsheets add empty ones."""
    if any(cell.strip() for cell in surplus):
        raise FormatError(
            f"{path}, line {line} has more cells than the {num_columns} columns of its header; numbers take a decimal "
            "point"
        )


def read_table(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a CSV file, without the blanks around columns and cells; a missing cell is empty."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, restval="")
            columns = [column.strip() for column in reader.fieldnames or []]
            check_columns(path, columns)
            reader.fieldnames = columns
            rows = []
            for row in reader:
                check_cells(path, reader.line_num, len(columns), row.get(None, ()))
                rows.append({column: row[column].strip() for column in columns})
            return columns, rows
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path} is no readable CSV file: {error}") from error
