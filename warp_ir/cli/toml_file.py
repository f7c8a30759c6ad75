"""Reading TOML files, in which presets of flags are kept."""

import sys
from typing import Any

from warp_ir.files import check_input
from warp_ir.scene import InputError


def read_toml(path: str) -> dict[str, Any]:
    """Reads a TOML file.

    Raises:
        InputError: The file cannot be read, or is not TOML.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib
    check_input(path, "a TOML file")
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except ValueError as error:  # not TOML, or not UTF-8
        raise InputError(f"{path}: is not TOML: {error}") from error
