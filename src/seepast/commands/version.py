"""seepast --version: what this installation is made of."""

from __future__ import annotations

from .console import Json, say


def version(*, json_: Json = False) -> int:
    """Show version, backends, processor and extras."""
    from ..about import about, about_text

    facts = about()
    say(about_text(facts), facts, json_)
    return 0
