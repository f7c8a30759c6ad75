"""Other renderers, to be measured beside ours in the same run. All are optional: what is absent is named, and why."""

from typing import Any


def find_peers(device: str) -> tuple[dict[str, Any], dict[str, str]]:
    """The peers that can run here, by name; and of those that cannot, the reason."""
    try:
        from peers.mitsuba_path import MitsubaPath, start

        start(device)
        paths = MitsubaPath()
    except Exception as error:  # whatever keeps a foreign library from starting
        return {}, dict.fromkeys(("mitsuba", "mitsuba-oidn"), f"no Mitsuba: {error}".splitlines()[0])
    try:
        from peers.mitsuba_oidn import MitsubaDenoised

        return {"mitsuba": paths, "mitsuba-oidn": MitsubaDenoised(paths)}, {}
    except Exception as error:
        return {"mitsuba": paths}, {"mitsuba-oidn": f"no Open Image Denoise: {error}".splitlines()[0]}
