"""The documents do what they say: every block of the README and of docs/ runs as it stands, and the site is built.

Python blocks of a document are one program, and commands run between them in the same folder, which has the scenes.
A comment before a block, which readers do not see, says that it needs a module (`<!-- needs NAME -->`), or why it
cannot run (`<!-- not run: WHY -->`). Pictures are small because the command `warp-ir` that the blocks find here adds
flags to what is written.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import warp_ir

ROOT = Path(__file__).parent.parent
DOCUMENTS = ["README.md", *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(
    r"(?:^<!-- (?P<comment>[^\n]*) -->\n)?^```(?P<language>\w*)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE
)
SMALL = {
    "render": ["-w", "32", "--iterations", "2"],
    "vpls": ["--light-paths", "32"],
    "compare": ["-w", "32", "--times", "0.1", "--reference-time", "0.5", "--methods", "vpl"],
}
"""Flags that are added to the commands of blocks; of a flag that is given twice the last one counts."""
NOT_RUN = {
    "README.md": ["python3 -m venv", ".venv/bin/warp-ir view", "python3 -m venv"],
    "docs/cluster.md": ["pip install", "ray start", "warp-ir render shot"],
    "docs/quickstart.md": [". .venv/bin/activate", "warp-ir view"],
}
"""What the blocks begin with that are marked as not to be run."""
COMMAND = f"""#!{sys.executable}
import sys
from warp_ir.cli import command
sys.argv += {SMALL!r}.get(sys.argv[1], [])
command()
"""


def blocks(name):
    """The blocks of a document, as (comment or "", language, text)."""
    for match in BLOCK.finditer((ROOT / name).read_text(encoding="utf-8")):
        yield match["comment"] or "", match["language"], match["text"]


@pytest.mark.parametrize("name", DOCUMENTS)
def test_blocks_are_programs_or_text(name):
    """Every fence is a block that the tests find; blocks that cannot run are those that are known."""
    found = list(blocks(name))
    fences = re.findall(r"^ *```", (ROOT / name).read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert 2 * len(found) == len(fences)
    assert {language for _, language, _ in found} <= {"sh", "python", "text"}
    marked = [text for comment, _, text in found if comment.startswith("not run: ")]
    expected = NOT_RUN.get(name, [])
    assert len(marked) == len(expected) and all(map(str.startswith, marked, expected))


@pytest.mark.parametrize("name", DOCUMENTS)
def test_commands_parse(name):
    """The command line understands every command of a block, also of those that are not run."""
    from warp_ir.cli.arguments import _parsers, parse

    known = "|".join(_parsers()[1])
    for _, language, text in blocks(name):
        if language == "sh":
            for command in re.findall(rf"warp-ir ((?:{known}) [^#\n;)&]+)", text):
                parse([word.strip("\"'") for word in command.split()])


@pytest.mark.extended
@pytest.mark.parametrize("name", [name for name in DOCUMENTS if any(kind != "text" for _, kind, _ in blocks(name))])
def test_blocks_run(name, tmp_path, monkeypatch):
    """A reader who copies the blocks one after the other gets no error."""
    (tmp_path / "scenes_usd").symlink_to(ROOT / "scenes_usd")
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "warp-ir").write_text(COMMAND, encoding="utf-8")
    (programs / "warp-ir").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    names: dict[str, object] = {}
    for comment, language, text in blocks(name):
        module = re.match(r"needs (\w+)", comment)
        if comment.startswith("not run: ") or (module and importlib.util.find_spec(module[1]) is None):
            continue
        if language == "python":
            exec(compile(text, name, "exec"), names)
        elif language == "sh":
            shell = ["bash", "-euo", "pipefail", "-c", text]
            done = subprocess.run(shell, env=environment, capture_output=True, text=True, timeout=600)
            assert done.returncode == 0, f"{text}\n{done.stdout}{done.stderr}"
    written = {path.name for path in tmp_path.iterdir()} - {"scenes_usd", ".venv"}
    assert written or name in ("docs/api.md",)


def test_every_public_name_has_an_example():
    """docs/api.md has a section for every public name, in which it is used; docs/reference.md shows its docstring."""
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^### `(\w+)`$", text, flags=re.MULTILINE)) == warp_ir.__all__
    for section in text.split("\n### ")[1:]:
        assert f"ir.{section.split('`')[1]}" in section or section.startswith("`Film`")
    reference = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^::: warp_ir\.(\w+)$", reference, flags=re.MULTILINE)) == warp_ir.__all__


def test_every_setting_is_listed():
    """docs/settings.md has a row for every field of `RenderSettings`."""
    import dataclasses

    text = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    rows = [row.split("|")[1] for row in text.splitlines() if row.startswith("| `")]
    listed = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert {field.name for field in dataclasses.fields(warp_ir.RenderSettings)} <= listed


@pytest.mark.extended
def test_pictures_are_made_by_the_gallery(monkeypatch, tmp_path, capsys):
    """scripts/make_gallery.py makes all pictures of the documents, and no others are there."""
    pytest.importorskip("matplotlib")
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    import make_gallery

    there = {path.name for path in (ROOT / "docs" / "pictures").iterdir()}
    assert there == set(make_gallery.PICTURES)
    texts = "".join((ROOT / name).read_text(encoding="utf-8") for name in DOCUMENTS)
    assert there == set(re.findall(r"\]\((?:docs/)?pictures/(\S+)\)", texts))
    monkeypatch.setattr(sys, "argv", ["make_gallery.py", str(tmp_path), "-k", "sets", "--quality", "0.01"])
    make_gallery.main()
    assert "sets.webp" in capsys.readouterr().out and (tmp_path / "sets.webp").stat().st_size > 1000


@pytest.mark.extended
def test_site_is_built(tmp_path):
    """MkDocs, in strict mode, finds every page, link, heading and docstring."""
    pytest.importorskip("mkdocs")
    # Without --quiet, which hides warnings from --strict.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    flags = (tmp_path / "site" / "cli.html").read_text(encoding="utf-8")
    assert all(f"--{flag}" in flags for flag in ("target-error", "contribution-to", "reference-time", "session-layer"))
    reference = (tmp_path / "site" / "reference.html").read_text(encoding="utf-8")
    assert all(f'id="warp_ir.{name}"' in reference for name in warp_ir.__all__)
    assert "Neumann" in (tmp_path / "site" / "how-it-works.html").read_text(encoding="utf-8")
