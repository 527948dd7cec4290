"""MJCF files that somebody else wrote: one plain file, which names no other."""

from pathlib import Path
from xml.etree.ElementTree import ParseError

import mujoco
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring

from palpate.errors import PalpateError


def read_mjcf(path: str | Path, plugin: str = "") -> mujoco.MjSpec:
    """The scene of a file, uncompiled. `plugin`: the only one that it may use.

    Raises `PalpateError` for what cannot be read, is no MJCF, or asks for other files or plugins.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
        root = fromstring(text, forbid_dtd=True)
    except (OSError, UnicodeDecodeError) as error:
        raise PalpateError(f"cannot read {path}: expected an MJCF file ({error})") from error
    except (ParseError, DefusedXmlException) as error:
        raise PalpateError(f"{path} is not plain XML: expected an MJCF file ({error})") from error
    if root.tag != "mujoco":
        raise PalpateError(f"{path} holds <{root.tag}>: expected MJCF, which begins with <mujoco>")
    others = {node.get("plugin") for node in root.iter("plugin")} - {None, plugin}
    foreign = [
        node.tag
        for node in root.iter()
        if node.tag == "include" or any(name.startswith("file") for name in node.attrib)
    ]
    if others or foreign:
        found = ", ".join(sorted(map(str, others))) or f"<{foreign[0]}> of another file"
        but = f" but {plugin}" if plugin else ""
        raise PalpateError(f"{path} uses {found}: expected one file by itself, with no plugin{but}")
    try:
        return mujoco.MjSpec.from_string(text)
    except ValueError as error:
        raise _unusable(path, error) from error


def compile_model(path: str | Path, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model of a scene that was read from `path`; raises `PalpateError` where it is none."""
    try:
        return spec.compile()
    except ValueError as error:
        raise _unusable(path, error) from error


def _unusable(path: str | Path, error: Exception) -> PalpateError:
    return PalpateError(f"MuJoCo cannot use {path}: {' '.join(str(error).split())}")
