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
        self._amounts: dict[str, dict[str, int]] = {}

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
        amounts = self._amounts.setdefault(text, {})
        amounts[str(path)] = amounts.get(str(path), 0) + amount

    def part(self) -> "Report":
        """An empty report of the same file: of what is read once, to be `include`d in many."""
        return Report(self.source, strict=self._strict)

    def include(self, part: "Report") -> None:
        """Say and count what another report has."""
        self.stats.update(part.stats)
        for text, amounts in part._amounts.items():
            mine = self._amounts.setdefault(text, {})
            for path, amount in amounts.items():
                mine[path] = mine.get(path, 0) + amount

    def mention(self, other: "Report") -> None:
        """Say and count what another report has and this one lacks, without counting again what both have."""
        self.stats.update({name: count for name, count in other.stats.items() if name not in self.stats})
        for text, amounts in other._amounts.items():
            mine = self._amounts.setdefault(text, {})
            mine.update({path: amount for path, amount in amounts.items() if path not in mine})

    def lines(self) -> tuple[str, ...]:
        """The warnings in the order in which they first came up."""
        return tuple(
            f"{_names(list(amounts))}: {text.replace('{n}', str(sum(amounts.values())))}"
            for text, amounts in self._amounts.items()
        )


def _names(paths: list[str]) -> str:
    if len(paths) <= _NAMED:
        return ", ".join(paths)
    return f"{', '.join(paths[:_NAMED])} and {len(paths) - _NAMED} more"
