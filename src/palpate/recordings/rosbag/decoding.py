"""Bytes of a ROS message into a tree of named fields: ROS 1, and CDR as in ROS 2.

`rosbags`, which knows the formats of ROS, turns the definition of a message type into Python code
and runs it. A definition out of a foreign file is therefore checked here before: nothing but plain
identifiers and small numbers gets into that code.
"""

import re
from collections.abc import Callable, Iterator
from typing import Any

from palpate.errors import PalpateError

LONGEST_ARRAY = 4096  # elements of an array of fixed length, for each of which code is made
_TYPE_NAME = re.compile(r"[A-Za-z]\w*(?:/[A-Za-z]\w*)+", re.ASCII)
_FIELD_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_IDL_RULE = "=" * 80 + "\n"

Decode = Callable[[bytes], Any]


def ros_decoder(kind: str, definition: str, encoding: str) -> Decode:
    """Decodes messages of the ROS type `kind`, such as "geometry_msgs/msg/PoseArray".

    `encoding` of the definition is that of an MCAP schema: "ros1msg", "ros2msg" or "ros2idl". An
    empty definition means one of the types that come with ROS 2 Humble, the last release whose
    bags do not hold their definitions.

    Raises `PalpateError` for a definition that cannot be used.
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    kind = normalize_msgtype(kind)
    if not definition:
        store = get_typestore(Stores.ROS2_HUMBLE)
    else:
        store = get_typestore(Stores.EMPTY)
        try:
            if encoding != "ros2idl":
                types = get_types_from_msg(definition, kind)
            elif not definition.startswith(_IDL_RULE):
                types = get_types_from_idl(definition)
            else:  # of several files, under a rule and a line "IDL: name" each
                types = {}
                for part in definition.split(_IDL_RULE)[1:]:
                    types |= get_types_from_idl(part.partition("\n")[2])
            _check(types)
            store.register(types)
        except PalpateError:
            raise
        except Exception as error:  # parsers of a grammar, and Python's own
            reason = str(error).partition("\n")[0]
            raise PalpateError(f"its definition is damaged ({reason})") from error
    if kind not in store.fielddefs:
        raise PalpateError("its definition is not in the file: record it again with ROS 2 Iron+")
    if encoding == "ros1msg":
        return lambda data: store.deserialize_ros1(data, kind)
    return lambda data: store.deserialize_cdr(data, kind)


def _check(types: dict[str, Any]) -> None:
    """Refuse names that are no identifiers, and arrays of fixed length that are too long."""
    from rosbags.interfaces import Nodetype

    for kind, (constants, fields) in types.items():
        for name in (kind, *(name for _, field in fields for name in _references(field))):
            if not _TYPE_NAME.fullmatch(name):
                raise PalpateError(f"its definition has a type called {name[:40]!r}")
        for name, *_ in (*constants, *fields):
            if not _FIELD_NAME.fullmatch(name):
                raise PalpateError(f"its definition has a field called {name[:40]!r}")
        for name, (node, details) in fields:
            if node == Nodetype.ARRAY and details[1] > LONGEST_ARRAY:
                raise PalpateError(
                    f"its field '{name}' is an array of {details[1]} elements; at most "
                    f"{LONGEST_ARRAY} are read"
                )


def _references(field: Any) -> Iterator[str]:
    """The names of other types in a parsed field: (node, its details)."""
    from rosbags.interfaces import Nodetype

    node, details = field
    if node == Nodetype.NAME:
        yield details
    elif node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        yield from _references(details[0])
