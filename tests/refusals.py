"""What a refusal looks like."""

from __future__ import annotations


def one_line(error):
    text = str(error.value)
    assert text
    assert "\n" not in text
    return text
