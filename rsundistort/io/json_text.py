"""JSON as people hand it in: whatever is wrong with it is one error with one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import FileError, FormatError

__all__ = ["read_json"]


def read_json(path: Path | str) -> Any:
    """What a JSON file says.

    Raises
    ------
    FileError, FormatError
        When it cannot be read; when it is no JSON, nested without end, or has numbers of thousands of digits.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from error
    except json.JSONDecodeError as error:
        raise FormatError(f"{path} is no valid JSON: {error}") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path} is no valid JSON: it is no UTF-8 text") from error
    except RecursionError as error:
        raise FormatError(f"{path} is no valid JSON: it is nested too deeply") from error
    except ValueError as error:  # Python's limit, whose words are about Python
        raise FormatError(f"{path} is no valid JSON: a number has too many digits") from error
