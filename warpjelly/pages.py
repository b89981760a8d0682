"""Pages that work from disk, in any browser: a template of this package, and what its places are filled with."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping
from importlib import resources
from typing import Any


def fill_page(package: str, name: str, *, title: str, tables: Mapping[str, Any], texts: Mapping[str, str]) -> str:
    """Return a page with everything in its places, which are {{NAME}} in the template. Values are never looked into.

    Args:
        package: of the template.
        name: of its file.
        title: for {{TITLE}}, any text.
        tables: for scripts of JSON, whatever JSON holds.
        texts: as they are.
    """
    # An element of script ends at "</script>", but not after "<!--" and "<script>", even in a string.
    scripts = {
        place: json.dumps(value, allow_nan=False, default=str).replace("<", "\\u003c")
        for place, value in tables.items()
    }
    values = {"TITLE": html.escape(title), **scripts, **texts}
    template = resources.files(package).joinpath(name).read_text(encoding="utf-8")
    return re.sub(r"\{\{([A-Z]+)\}\}", lambda place: values[place[1]], template)
