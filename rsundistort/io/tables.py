"""Tables that people write: CSV files with a header."""

from __future__ import annotations

import csv
from pathlib import Path

from ..errors import FileError, FormatError

__all__ = ["read_table"]


def read_table(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a CSV file, without the blanks around columns and cells; a missing cell is empty."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, restval="")
            columns = [column.strip() for column in reader.fieldnames or []]
            reader.fieldnames = columns
            rows = []
            for row in reader:
                # spreadsheets end lines with empty cells
                if any(row.get(None, ())):
                    raise FormatError(
                        f"{path}, line {reader.line_num} has more cells than the {len(columns)} columns of its header; "
                        "numbers take a decimal point"
                    )
                rows.append({column: row[column].strip() for column in columns})
            return columns, rows
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileError(f"{path} is no readable CSV file: {error}") from error
