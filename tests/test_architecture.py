"""The rules of ARCHITECTURE.md that a test can keep: imports, kernels, documentation, layout and words."""

import ast
import inspect
import io
import re
import tokenize
from pathlib import Path

import pytest

import warp_ir as ir

ROOT = Path(__file__).parent.parent
PACKAGE = Path(ir.__file__).parent

# Lowest first: a module may import from its own layer's left and from the layers before it.
LAYERS = [
    ["scene"],
    ["files"],
    ["image", "metrics"],
    ["settings"],
    ["memory"],
    ["device"],
    ["sampling"],
    ["procedural", "usd", "bvh", "texture", "tiles"],
    ["light_modifiers", "bsdf"],
    ["device_scene"],
    ["surface"],
    ["lights"],
    ["gbuffer"],
    ["coverage", "film", "vpl"],
    ["guiding", "reconstruction", "scheduling"],
    ["estimators", "interrupt"],
    ["renderer", "simulation"],
    ["engine"],
    ["newton", "mujoco"],
    ["preview"],
    ["view"],
    ["cli"],
    ["__main__"],
]
USD_LAYERS = [
    ["values"],
    ["geometry", "images", "stage"],
    ["lights"],
    ["shading"],
    ["settings"],
    ["camera_prim", "diagnose", "linking", "time_varying", "vpl_layers"],
    ["edit_layer", "live_edits", "traverse"],
    ["assemble"],
    ["load"],
    ["__init__"],
]
"""The packages and files of `warp_ir.usd`, under the same rule as `LAYERS`."""
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def home(path, package=PACKAGE):
    """The module or folder directly under a package to which a file belongs."""
    return path.relative_to(package).parts[0].removesuffix(".py")


def imports(tree, package=PACKAGE):
    """The module or folder directly under a package of each import from it, anywhere in a file."""
    prefix = ".".join(package.relative_to(PACKAGE.parent).parts)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from [a.name.removeprefix(prefix + ".").split(".")[0] for a in node.names if prefix + "." in a.name]
        elif isinstance(node, ast.ImportFrom) and node.module == prefix:
            modules = {entry.stem for entry in package.iterdir()}
            yield from [a.name for a in node.names if a.name in modules]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(prefix + "."):
            yield node.module.removeprefix(prefix + ".").split(".")[0]


def assert_one_way(path, package, layers):
    """A file imports from lower layers of the package and from its own folder, and from nothing else of it."""
    rank = {name: k for k, layer in enumerate(layers) for name in layer}
    own = home(path, package)
    for other in imports(ast.parse(path.read_text(encoding="utf-8")), package):
        assert own in rank and other in rank, f"{own} or {other} has no layer"
        assert other == own or rank[other] < rank[own], f"{own} imports {other}"


def relative(path):
    """The name of a file in the package, the same on all systems."""
    return path.relative_to(PACKAGE).as_posix()


@pytest.mark.parametrize("path", FILES, ids=relative)
def test_imports_run_one_way(path):
    """No module imports from a layer above its own, or from its own."""
    assert_one_way(path, PACKAGE, LAYERS)


@pytest.mark.parametrize("path", [p for p in FILES if home(p) == "usd"], ids=relative)
def test_imports_among_readers_run_one_way(path):
    """The families of the USD readers are layers too."""
    assert_one_way(path, PACKAGE / "usd", USD_LAYERS)


def functions(decorator):
    """Every function of the package with a decorator whose name ends so, as (file, function)."""
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and any(
                re.match(rf"(wp\.)?{decorator}\b", ast.unparse(d)) for d in node.decorator_list
            ):
                yield path, node


@pytest.mark.parametrize(
    "path, kernel", list(functions("kernel")), ids=lambda x: home(x) if isinstance(x, Path) else x.name
)
def test_kernels_follow_the_rules(path, kernel):
    """Private verb, first argument `first`, at most 8 arguments and 75 lines; no adjoint, unrolling, atomics, tiles."""
    arguments = [a.arg for a in kernel.args.args]
    assert kernel.name.startswith("_") and arguments[0] == "first" and len(arguments) <= 8
    assert kernel.end_lineno - kernel.lineno <= 75
    source = path.read_text(encoding="utf-8")
    assert 'wp.set_module_options({"enable_backward": False, "max_unroll": 0})' in source
    assert "atomic_" not in source and "wp.tile" not in source


MAX_LINES, MAX_ARGUMENTS = 75, 10
EXCEPTIONS = {
    "vpl/emission.py:trace_light_path",
}
"""Device functions that are longer than `MAX_LINES` or take more than `MAX_ARGUMENTS`."""


def test_device_functions_are_small():
    """No `@wp.func` is longer or takes more arguments than the limits, but for exceptions that are still needed."""
    large = {
        f"{relative(path)}:{node.name}"
        for path, node in functions("func(_native)?")
        if node.end_lineno - node.lineno > MAX_LINES or len(node.args.args) > MAX_ARGUMENTS
    }
    assert sorted(large - EXCEPTIONS) == [], f"more than {MAX_LINES} lines or {MAX_ARGUMENTS} arguments"
    assert sorted(EXCEPTIONS - large) == [], "exceptions that are not needed"


def test_public_names_are_documented():
    """Every public name, and every public method of it, has a docstring."""
    for name in ir.__all__:
        thing = getattr(ir, name)
        assert inspect.getdoc(thing), name
        if inspect.isclass(thing):
            for attribute, value in vars(thing).items():
                if inspect.isfunction(value) and not attribute.startswith("_"):
                    assert inspect.getdoc(value), f"{name}.{attribute}"


def layout(text):
    """The files that the layout block of ARCHITECTURE.md names, relative to the package.

    A line of the block whose first word ends in "/" begins a folder, "warp_ir/" being the package itself; the names
    that end in .py, there and on the lines that follow, are files of it.
    """
    block = text.split("\n## Layout\n")[1].split("```")[1]
    folder, files = None, set()
    for line in block.splitlines():
        if heading := re.match(r"\s*(\w[\w/]*/)(\s|$)", line):
            folder = heading[1].removeprefix("warp_ir/")
        if folder is not None:
            files |= {folder + name for name in re.findall(r"(?<![\w./])\w+\.py\b", line)}
    return files


def differences(text, files):
    """The modules that the layout does not name, and the names in it that are no modules; __init__.py may be either."""
    named, files = layout(text), set(files)
    return sorted(f for f in files - named if "__" not in f), sorted(named - files)


def test_layout_is_complete():
    """ARCHITECTURE.md names every module under its folder, and no other."""
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    assert differences(text, map(relative, sorted(PACKAGE.rglob("*.py")))) == ([], [])


def test_gaps_of_a_layout_are_noticed():
    """Three files of one name, in folders of their own, each have to be named."""
    block = "```\nwarp_ir/  a.py this ·\n          b.py that\nx/        a.py c.py\nx/y/\n  b.py\n```"
    text = f"# A\n\n## Layout\n\n{block}\n\n## B\nz.py\n"
    assert layout(text) == {"a.py", "b.py", "x/a.py", "x/c.py", "x/y/b.py"}
    assert differences(text, ["a.py", "b.py", "x/__init__.py", "x/a.py", "x/b.py", "x/y/a.py", "x/y/b.py"]) == (
        ["x/b.py", "x/y/a.py"],
        ["x/c.py"],
    )


RETIRED_WORDS = [
    (r"pilot\w*", "guiding, probe paths"),
    (r"kept(?=\()", "scratch"),
    (r"beside(?=\()", "overlap"),
    (r"worthwhile", "the quantity that is compared"),
    (r"undisturbed", "to completion"),
    (r"(?<!in )foreign", "vendor"),
    (r"feels?", "depends on, contributes to"),
    (r"g[ia]ve[sn]? back|gives? it back", "compensate, shrink"),
    (r"(?<!\.)(?<!def )glow(s|ed|ing)", "emit, emissive; `glow` is the public field alone"),
]
"""Words that stand for nothing in the field, in code, comments and prose, and what to write instead."""
RETIRED_NAMES = {
    "arriving": "visibility, irradiance",
    "beyond": "bias_compensation, unclamped",
    "carry": "velocities",
    "judge": "estimate",
    "observe": "accumulate",
    "once": "direct",
    "placing": "instances",
    "presence": "alpha",
    "rings": "target annuli",
    "sharing": "prototypes",
    "worth": "importance",
}
"""Words that no name in the package has as a part, and what to call it instead."""


def retired_words(text):
    """Lines of a text with words that are retired, and what to write instead."""
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, better in RETIRED_WORDS:
            for match in re.finditer(rf"(?<![^\W_])(?:{pattern})(?![^\W_])", line, flags=re.IGNORECASE):
                yield f"{number}: {match[0]!r}: write {better}"


def retired_names(text):
    """Lines of a program with names that have a retired word as a part, and what to call it instead."""
    if not re.search("|".join(RETIRED_NAMES), text, flags=re.IGNORECASE):
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME:
            for word in set(token.string.lower().split("_")) & RETIRED_NAMES.keys():
                yield f"{token.start[0]}: {token.string!r}: call it {RETIRED_NAMES[word]}"


def test_retired_words_stay_away():
    """Code and documents use the terms of the field."""
    documents = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").rglob("*.md"))]
    found = []
    for path in [*sorted(PACKAGE.rglob("*.py")), *documents]:
        text = path.read_text(encoding="utf-8")
        lines = [*retired_words(text), *(retired_names(text) if path.suffix == ".py" else ())]
        found += [f"{path.relative_to(ROOT).as_posix()}:{line}" for line in lines]
    assert not found, "\n".join(found)


def test_retired_words_are_noticed():
    """Whole words count, in any case, and parts of names."""
    assert len(list(retired_words("The Pilot gives back\na _pilot_film; copilots are worthy\n"))) == 3
    assert len(list(retired_names("def once(worth_rows): return concert + pennyworth  # once\n"))) == 2
