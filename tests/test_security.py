"""What docs/security.md claims: a stage is read, and neither connects, nor starts, nor writes anything."""

import re
import socket
import sys
from pathlib import Path

import pytest

import warp_ir as ir

TESTS = Path(__file__).parent
ADDRESSES = """#usda 1.0
( subLayers = [@{url}/layer.usda@] )
def Mesh "Card" (
    prepend apiSchemas = ["MaterialBindingAPI"]
    prepend references = @{url}/card.usdc@
    prepend payload = @{url}/more.usdz@
) {{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    rel material:binding = </Look>
}}
def Material "Look" (prepend references = @{url}/look.mtlx@) {{
    token outputs:surface.connect = </Look/S.outputs:surface>
    def Shader "S" {{
        uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </Look/T.outputs:rgb>
        token outputs:surface
    }}
    def Shader "T" {{
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{url}/texture.png@
        float3 outputs:rgb
    }}
}}
def DomeLight "Sky" {{ asset inputs:texture:file = @{url}/sky.exr@ }}
def RectLight "Lamp" (prepend apiSchemas = ["ShapingAPI"]) {{ asset inputs:shaping:ies:file = @{url}/lamp.ies@ }}
"""
_events: list[str] = []


def _record(event: str, arguments: object) -> None:
    if event in ("socket.connect", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "pickle.find_class"):
        _events.append(event)


def test_a_stage_opens_no_connection_and_starts_no_program(tmp_path):
    """Addresses of a server that listens, in all places that name files: nobody calls it, from Python or C++."""
    sys.addaudithook(_record)  # for good: hooks cannot be removed
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        (tmp_path / "a.usda").write_text(ADDRESSES.format(url=f"http://127.0.0.1:{server.getsockname()[1]}"))
        _events.clear()
        try:
            scene = ir.load_usd(tmp_path / "a.usda")
            assert scene.warnings
        except ir.InputError as error:
            assert "\n" not in str(error)
        assert not _events
        with pytest.raises(BlockingIOError):
            server.accept()


def test_every_claim_names_a_test():
    """The tests that docs/security.md names exist."""
    text = (TESTS.parent / "docs" / "security.md").read_text(encoding="utf-8")
    named = re.findall(r"`(\w+\.py)::(\w+)`", text)
    assert len(named) >= 10
    for file, name in named:
        assert f"def {name}(" in (TESTS / file).read_text(encoding="utf-8"), (file, name)
