"""What the loader could not honour: one line per kind of trouble, and counts of everything."""

from collections import Counter

from warp_ir.scene import InputError

_NAMED = 4
"""How many prims a coalesced warning names."""


class Unreadable(Exception):
    """This prim cannot be read, and the message says why; whoever walks the stage names it and goes on."""


class Report:
    """Collects warnings (same text, many prims: one line) and counts.

    Args:
        source: The file, named in errors.
        strict: Whether the first warning is an `InputError`.
    """

    def __init__(self, source: str, *, strict: bool = False) -> None:
        self.source = source
        self.stats: Counter[str] = Counter()
        self._strict = strict
        self._paths: dict[str, dict[str, None]] = {}
        self._amount: Counter[str] = Counter()

    def warn(self, path: object, what: str, amount: int = 1) -> None:
        """Say that something about a prim was skipped, approximated or guessed.

        Args:
            path: Of the prim.
            what: What and why. Prims with the same text share a line, in which ``{n}`` is their total amount.
            amount: What this prim adds to ``{n}``.
        """
        text = " ".join(what.split())
        if self._strict:
            raise InputError(f"{self.source}: {path}: {text.replace('{n}', str(amount))}")
        self._paths.setdefault(text, {})[str(path)] = None
        self._amount[text] += amount

    def lines(self) -> tuple[str, ...]:
        """The warnings in the order in which they first came up."""
        return tuple(
            f"{_names(list(paths))}: {text.replace('{n}', str(self._amount[text]))}"
            for text, paths in self._paths.items()
        )


def _names(paths: list[str]) -> str:
    if len(paths) <= _NAMED:
        return ", ".join(paths)
    return f"{', '.join(paths[:_NAMED])} and {len(paths) - _NAMED} more"
