"""YAML text to plain values and back, without surprises.

PyYAML follows YAML 1.1: it reads `1e-05` as a string, `12:30` as a number, `no` as false and an id
of 32 decimal digits as an integer. Here only true / false, null, and numbers that print back to
the same value are converted; every other scalar stays the text that it is.
"""

from __future__ import annotations

import re
from typing import Any

import yaml

from maplab_py.errors import MapError

_ID_LENGTH = 32
_DIGITS = re.compile(r"^[0-9]*e?[0-9]*$")
_SCALARS = (
    ("tag:yaml.org,2002:bool", r"^(?:true|True|TRUE|false|False|FALSE)$", "tTfF"),
    ("tag:yaml.org,2002:null", r"^(?:~|null|Null|NULL|)$", "~nN\0"),
    ("tag:yaml.org,2002:int", r"^-?(?:0|[1-9][0-9]*)$", "-0123456789"),
    (
        "tag:yaml.org,2002:float",
        r"^-?(?:(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+"
        r"|\.(?:inf|Inf|INF))$|^\.(?:nan|NaN|NAN)$",
        "-0123456789.",
    ),
    ("tag:yaml.org,2002:merge", r"^<<$", "<"),
)


class _Resolver:
    """Decides which plain scalars are not text; shared by reader and writer."""

    def resolve(self, kind: type[Any], value: Any, implicit: Any) -> Any:
        is_plain = kind is yaml.ScalarNode and isinstance(value, str) and implicit[0]
        if is_plain and len(value) == _ID_LENGTH and value.isalnum():
            return "tag:yaml.org,2002:str"
        return super().resolve(kind, value, implicit)  # type: ignore[misc]


class _Loader(_Resolver, yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    line = key.start_mark.line + 1
                    raise yaml.MarkedYAMLError(problem=f"key '{key.value}' twice, line {line}")
                seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(_Resolver, yaml.SafeDumper):
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write shared values out in full."""
        del data
        return True

    def represent_str(self, data: str) -> Any:
        """Quote ids that other readers would take for a number."""
        style = "'" if len(data) == _ID_LENGTH and _DIGITS.match(data) else None
        return self.represent_scalar("tag:yaml.org,2002:str", data, style)


_Dumper.add_representer(str, _Dumper.represent_str)


for _tag, _pattern, _first in _SCALARS:
    for _class in (_Loader, _Dumper):
        for _character in _first:
            _key = "" if _character == "\0" else _character
            _entry = (_tag, re.compile(_pattern))
            _class.yaml_implicit_resolvers.setdefault(_key, []).append(_entry)


def parse_yaml(text: str, source: str) -> Any:
    """Return the plain value of a YAML text.

    Raises:
        MapError: The text is not YAML, has a key twice, or has an alias to itself.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise MapError(f"{source}: not valid YAML: {' '.join(lines)}") from error


def dump_yaml(value: Any) -> str:
    """Return a YAML text, innermost lists in one line; floats read back bit-identical."""
    return str(
        yaml.dump(
            value,
            Dumper=_Dumper,
            sort_keys=False,
            default_flow_style=None,
            allow_unicode=True,
            width=1 << 20,
        )
    )
