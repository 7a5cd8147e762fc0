"""Numbers from topics whose messages have a header, at the times that these headers say."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from xtdrone_interaction.analysis.columns import Series
from xtdrone_interaction.analysis.layout import STAMP
from xtdrone_interaction.analysis.source import Layouts, by_connection, large_batches, open_source


def read_stamped(path: Path, fields: Mapping[str, tuple[str, ...]]) -> dict[str, Series]:
    """Read fields of topics.

    Args:
        path: of a recording, see :func:`~xtdrone_interaction.analysis.source.open_source`.
        fields: by topic, as ``pose.position.x``.

    Returns:
        By topic, in order of time, one row for a time; topics without such messages are left out.

    Raises:
        BagError: nothing can be read of the recording.
    """
    source = open_source(path)
    layouts = Layouts()
    parts: dict[str, list[Series]] = {}
    for batch in large_batches(source):
        for number, messages in by_connection(batch):
            connection = source.connections.get(number)
            if connection is None or connection.topic not in fields:
                continue
            wanted = fields[connection.topic]
            layout = layouts.of(connection)
            if layout is None or not layout.stamped or not all(path in layout.fields for path in wanted):
                continue
            decoded = layout.decode(messages.data, messages.offset, messages.length, {*wanted, *STAMP})
            part = Series(decoded.stamps() * 1e-9, decoded.numbers(wanted))
            parts.setdefault(connection.topic, []).append(part)
    return {topic: _joined(found) for topic, found in parts.items()}


def _joined(parts: list[Series]) -> Series:
    time = np.concatenate([part.time for part in parts])
    value = np.concatenate([part.value for part in parts])
    time, first = np.unique(time, return_index=True)
    return Series(time, value[first])
