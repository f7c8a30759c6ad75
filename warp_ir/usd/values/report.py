"""The report of a read: warnings about what could not be honoured, one line per kind, and counts."""

from collections import Counter

from warp_ir.scene import InputError

_MAX_NAMED_PRIMS = 4
"""Maximum number of prims that a coalesced warning names."""


class Unreadable(Exception):
    """A value or a prim cannot be read; the message says why. Callers name the prim and continue."""


class Report:
    """Collects counts and warnings; warnings with the same text are coalesced into one line for all their prims.

    Args:
        source: Path of the file, named in errors.
        strict: Whether a warning is raised as an `InputError`.
    """

    def __init__(self, source: str, *, strict: bool = False) -> None:
        self.source = source
        self.stats: Counter[str] = Counter()
        self._strict = strict
        self._amounts: dict[str, dict[str, int]] = {}

    def warn(self, path: object, what: str, amount: int = 1) -> None:
        """Warn that something about a prim was skipped, approximated or guessed.

        Args:
            path: Path of the prim.
            what: What happened and why; ``{n}`` stands for the total amount over all prims with the same text.
            amount: Amount that this prim adds to ``{n}``.
        """
        text = " ".join(what.split())
        if self._strict:
            raise InputError(f"{self.source}: {path}: {text.replace('{n}', str(amount))}")
        amounts = self._amounts.setdefault(text, {})
        amounts[str(path)] = amounts.get(str(path), 0) + amount

    def section(self) -> "Report":
        """A new empty report of the same file, which others `include`."""
        return Report(self.source, strict=self._strict)

    def include(self, section: "Report") -> None:
        """Add the warnings and the counts of another report to this one."""
        self.stats.update(section.stats)
        for text, amounts in section._amounts.items():
            mine = self._amounts.setdefault(text, {})
            for path, amount in amounts.items():
                mine[path] = mine.get(path, 0) + amount

    def include_new(self, other: "Report") -> None:
        """Add those warnings and counts of another report that this one lacks; those that both have are unchanged."""
        self.stats.update({name: count for name, count in other.stats.items() if name not in self.stats})
        for text, amounts in other._amounts.items():
            mine = self._amounts.setdefault(text, {})
            mine.update({path: amount for path, amount in amounts.items() if path not in mine})

    def lines(self) -> tuple[str, ...]:
        """The warnings in the order of their first occurrence, one line each."""
        return tuple(
            f"{_names(list(amounts))}: {text.replace('{n}', str(sum(amounts.values())))}"
            for text, amounts in self._amounts.items()
        )


def _names(paths: list[str]) -> str:
    if len(paths) <= _MAX_NAMED_PRIMS:
        return ", ".join(paths)
    return f"{', '.join(paths[:_MAX_NAMED_PRIMS])} and {len(paths) - _MAX_NAMED_PRIMS} more"
