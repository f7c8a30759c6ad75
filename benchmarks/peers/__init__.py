"""Other renderers, measured in the same run as ours. All are optional: the run names the missing ones and why."""

from methods import Method


def find_peers(device: str) -> tuple[dict[str, Method], dict[str, str]]:
    """The peers that can run, by name; and for each of the others the reason why it cannot."""
    try:
        from peers.mitsuba_path import MitsubaPath, start

        start(device)
        paths = MitsubaPath()
    except Exception as error:  # a library that is not ours may fail to start in any way
        return {}, dict.fromkeys(("mitsuba", "mitsuba-oidn"), f"no Mitsuba: {error}".splitlines()[0])
    try:
        from peers.mitsuba_oidn import MitsubaDenoised

        return {"mitsuba": paths, "mitsuba-oidn": MitsubaDenoised(paths)}, {}
    except Exception as error:
        return {"mitsuba": paths}, {"mitsuba-oidn": f"no Open Image Denoise: {error}".splitlines()[0]}
