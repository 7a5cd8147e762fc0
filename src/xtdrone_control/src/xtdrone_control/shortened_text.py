"""Texts of unknown length in messages."""


def shortened(text: str, most: int = 200) -> str:
    """Return a text for a message: its first ``most`` characters, with a mark if it is longer."""
    return text if len(text) <= most else f"{text[:most]}..."
