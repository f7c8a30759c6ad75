"""The house keeps its order: imports run one way, kernels follow their rules, public names are documented."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import warp_ir as ir

PACKAGE = Path(ir.__file__).parent

# Lowest first: a module may import from its own layer's left and from the layers before it.
LAYERS = [
    ["scene"],
    ["image", "metrics"],
    ["settings"],
    ["memory"],
    ["device"],
    ["sampling"],
    ["procedural", "usd", "bvh", "texture", "tiles"],
    ["light_modifiers"],
    ["device_scene"],
    ["surface"],
    ["lights"],
    ["gbuffer"],
    ["film", "vpl"],
    ["guiding", "reconstruction", "scheduling"],
    ["estimators", "interrupt"],
    ["renderer"],
    ["preview"],
    ["cli"],
    ["__main__"],
]
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p != PACKAGE / "__init__.py")


def home(path):
    """The module or folder directly under the package to which a file belongs."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(tree):
    """Every `warp_ir.x` that a file imports, anywhere in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("warp_ir"):
            parts = node.module.split(".")
            yield from (
                [parts[1]]
                if len(parts) > 1
                else [a.name for a in node.names if (PACKAGE / a.name).exists() or (PACKAGE / f"{a.name}.py").exists()]
            )
        elif isinstance(node, ast.Import):
            yield from [a.name.split(".")[1] for a in node.names if a.name.startswith("warp_ir.")]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    """No module imports from a layer above its own, or from its own."""
    own = home(path)
    for other in imports(ast.parse(path.read_text())):
        assert other == own or RANK[other] < RANK[own], f"{own} imports {other}"


def kernels():
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list):
                yield pytest.param(path, node, id=f"{home(path)}.{node.name}")


@pytest.mark.parametrize("path, kernel", list(kernels()))
def test_kernels_follow_the_rules(path, kernel):
    """Private verb, first argument `first`, at most 8 arguments and 75 lines; no adjoint, unrolling, atomics, tiles."""
    arguments = [a.arg for a in kernel.args.args]
    assert kernel.name.startswith("_") and arguments[0] == "first" and len(arguments) <= 8
    assert kernel.end_lineno - kernel.lineno <= 75
    source = path.read_text()
    assert 'wp.set_module_options({"enable_backward": False, "max_unroll": 0})' in source
    assert "atomic_" not in source and "wp.tile" not in source


def test_public_names_are_documented():
    """Every public name, and every public method of it, has a docstring."""
    for name in ir.__all__:
        thing = getattr(ir, name)
        assert inspect.getdoc(thing), name
        if inspect.isclass(thing):
            for attribute, value in vars(thing).items():
                if inspect.isfunction(value) and not attribute.startswith("_"):
                    assert inspect.getdoc(value), f"{name}.{attribute}"


def test_importing_costs_nothing():
    """`import warp_ir` loads neither Warp nor USD nor a picture library, nor even NumPy."""
    code = (
        "import sys, warp_ir; print(sorted({'warp','pxr','pyvista','OpenImageIO','numpy','rich'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


def test_unknown_names_are_attribute_errors():
    """A misspelt name fails as in any module."""
    with pytest.raises(AttributeError, match="rendr"):
        _ = ir.rendr
