"""Convert YAML text to plain values and back.

PyYAML follows YAML 1.1: it reads `1e-05` as a string, `12:30` as a number, `no` as false and an id
of 32 decimal digits as an integer. Here only true / false, null, and numbers that print back to
the same value are converted; every other scalar stays text.
"""

import re
from typing import Any

import yaml

from maplab_py.errors import MapError
from maplab_py.input_files import DEFAULT_MAX_BYTES, RAISE_THE_BOUND

_BYTES_PER_VALUE = 4000
"""Memory of one value while a text is read: events, nodes with their marks, values."""
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
    """Resolver of plain scalars, shared by reader and writer."""

    def resolve(self, kind: type[Any], value: Any, implicit: Any) -> Any:
        is_plain = kind is yaml.ScalarNode and isinstance(value, str) and implicit[0]
        if is_plain and len(value) == _ID_LENGTH and value.isalnum():
            return "tag:yaml.org,2002:str"
        return super().resolve(kind, value, implicit)  # type: ignore[misc]


class _TooLarge(yaml.YAMLError):
    """The text expands to more values than the bound allows."""


class _Loader(_Resolver, yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, text: str, most_values: int) -> None:
        super().__init__(text)
        self._most_values = most_values
        self._values = 0  # with those that aliases repeat
        self._values_of: dict[int, int] = {}  # by node

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Count the values of a node with expanded aliases."""
        is_alias = self.check_event(yaml.AliasEvent)
        before = self._values
        node = super().compose_node(parent, index)
        if is_alias:
            self._values += self._values_of.get(id(node), 1)
        else:
            self._values += 1
            if node is not None:
                self._values_of[id(node)] = self._values - before
        if self._values > self._most_values:
            raise _TooLarge(
                f"it stands for more than {self._most_values} values, aliases written out"
            )
        return node

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


def parse_yaml(text: str, source: str, max_bytes: int = DEFAULT_MAX_BYTES) -> Any:
    """Return the plain value of a YAML text.

    Raises:
        MapError: The text is not YAML, has a key twice, has an alias to itself, or stands for more
            values than fit into max_bytes of memory.
    """
    loader = None
    try:
        loader = _Loader(text, max_bytes // _BYTES_PER_VALUE)
        return loader.get_single_data()
    except _TooLarge as error:
        raise MapError(f"{source}: {error}; {RAISE_THE_BOUND}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = source if mark is None else f"{source}:{mark.line + 1}"
        reason = problem or " ".join(str(error).split())
        raise MapError(f"{where}: not valid YAML: {reason}") from error
    finally:
        if loader is not None:
            loader.dispose()


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
