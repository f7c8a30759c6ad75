"""Hooks of MkDocs: pages of the site that are files elsewhere in the repository, and flags of the command line.

`mkdocs build --strict` runs them; see mkdocs.yml. Pages of docs/ are written for both readers, those of the site and
those of the repository: their links are relative to the file, and are changed here where the site has another layout.
"""

import argparse
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from warp_ir.cli.arguments import _parsers

ROOT = Path(__file__).parent.parent
FROM_OUTSIDE = {
    "index.md": "README.md",
    "architecture.md": "ARCHITECTURE.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "tests.md": "tests/README.md",
    "benchmarks.md": "benchmarks/README.md",
    "scenes.md": "scenes_usd/README.md",
    "examples.md": "examples/README.md",
}
"""Page of the site, and the file of the repository that it shows."""
_LINK = re.compile(r"(!?)\[([^\]\[]*)\]\((?!\w+:)([^)#\s]+)(#[^)\s]*)?\)")
"""A link or picture: "!", the text, a relative path, and a heading."""


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages from outside docs/."""
    for page, source in FROM_OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Changes links, and puts flags in the place of `<!-- flags of warp-ir -->`."""
    uri = page.file.src_uri
    markdown = _relink(markdown, FROM_OUTSIDE.get(uri, f"docs/{uri}"), uri)
    return markdown.replace("<!-- flags of warp-ir -->", "\n".join(_commands()))


def _relink(markdown: str, source: str, uri: str) -> str:
    """Links between files of the repository become links between pages; those to other files become plain text.

    Args:
        markdown: The text.
        source: The path of its file in the repository.
        uri: The path of its page in the site.
    """
    pages = {path: page for page, path in FROM_OUTSIDE.items()}

    def change(match: re.Match[str]) -> str:
        picture, text, path, heading = match.groups()
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        page = pages.get(target) or (target.removeprefix("docs/") if target.startswith("docs/") else None)
        if page is None:
            return text
        return f"{picture}[{text}]({posixpath.relpath(page, posixpath.dirname(uri) or '.')}{heading or ''})"

    return _LINK.sub(change, markdown)


def _commands() -> Iterator[str]:
    """Every command of the parser with its flags by group, as Markdown with definition lists."""
    for name, parser in _parsers()[1].items():
        yield f"## warp-ir {name}\n\n{parser.description}\n"
        for group in parser._action_groups:
            shown = [action for action in group._group_actions if action.help != argparse.SUPPRESS]
            shown = [action for action in shown if action.dest != "help"]
            if shown:
                title = {"positional arguments": "arguments", "options": "other"}.get(str(group.title), group.title)
                yield f"### {name}: {title}\n"
            for action in shown:
                yield f"`{_signature(action)}`\n:   {_text(str(action.help))}\n"
        if parser.epilog:
            yield f"```text\n{parser.epilog.strip()}\n```\n"


def _signature(action: argparse.Action) -> str:
    """Names of a flag and its values, as in the usage: "-w, --width N"."""
    metavar = action.metavar or ("{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest)
    if not action.option_strings:
        return str(metavar) if action.nargs != "?" else f"[{metavar}]"
    values = "" if action.nargs == 0 else " ".join(metavar) if isinstance(metavar, tuple) else str(metavar)
    if isinstance(action.nargs, int) and action.nargs > 1 and not isinstance(metavar, tuple):
        values = " ".join([values] * action.nargs)
    return f"{', '.join(action.option_strings)} {values}".strip()


def _text(text: str) -> str:
    """The text of a flag's help as Markdown: percent signs are single, and what Markdown would read is escaped."""
    return re.sub(r"([*_`<|])", r"\\\1", text.replace("%%", "%"))
