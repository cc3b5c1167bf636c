"""All fuzz targets by name, the most exposed first."""

from __future__ import annotations

import fuzz_adapters
import fuzz_monitor

_ORDER = ("mavlink", "zenoh", "commands", "subscriber", "pipeline-quad", "cdr", "mcap", "tlog")
_ALL = {target.name: target for target in (*fuzz_adapters.TARGETS, *fuzz_monitor.TARGETS)}

TARGETS = {name: _ALL[name] for name in (*_ORDER, *(name for name in _ALL if name not in _ORDER))}
