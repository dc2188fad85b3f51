"""Configs as JSON, and the differences between two configs by flag."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping
from typing import Any, get_args, get_origin, get_type_hints

from cmig_jax.config import Config, ModelFlags


def to_json(config: Config) -> str:
    """Write a config as indented JSON; `network` names the class of its `model` flags."""
    return json.dumps({"network": config.model.network} | dataclasses.asdict(config), indent=2) + "\n"


def parse_json(text: str) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        ValueError: not JSON, or not an object.
    """
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"config: expected JSON ({error})") from error
    if not isinstance(values, dict):
        raise ValueError(f"config = {values!r}: expected an object of flags")
    return values


def from_values(values: Mapping[str, Any], networks: Mapping[str, type[ModelFlags]]) -> Config:
    """Build a config from the values that `to_json` wrote.

    Args:
        values: the parsed JSON.
        networks: flag classes by the name of their network.

    Raises:
        ValueError: an unknown network or flag, or a value outside its choices; the message names the flag. A missing flag takes its
            default, so that configs from before the flag existed keep their meaning.
    """
    network = values.get("network", "")
    if network not in tuple(networks):
        raise ValueError(f"config.network = {network!r}: expected one of {', '.join(networks)}")
    flags = {name: value for name, value in values.items() if name != "network"}
    return _build(Config, flags, "config", {ModelFlags: networks[network]})


def flat(config: Config) -> dict[str, Any]:
    """Return the flags of a config by their dotted names, such as `data.points`."""
    return dict(_flatten(dataclasses.asdict(config)))


def differences(old: Config, new: Config) -> list[str]:
    """List the flags in which two configs differ, as `flag: old -> new`."""
    before = {"network": old.model.network} | flat(old)
    after = {"network": new.model.network} | flat(new)
    flags = dict.fromkeys([*before, *after])
    return [f"{flag}: {before.get(flag)} -> {after.get(flag)}" for flag in flags if before.get(flag) != after.get(flag)]


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _build(kind: type, values: Any, where: str, subclasses: Mapping[type, type]) -> Any:
    kind = subclasses.get(kind, kind)
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} = {values!r}: expected an object of flags")
    hints = {field.name: get_type_hints(kind)[field.name] for field in dataclasses.fields(kind)}
    if unknown := sorted(set(values) - set(hints)):
        raise ValueError(f"{where}: unknown flags {unknown}: this config is of another version")
    required = [f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING]
    if missing := [name for name in required if name not in values]:
        raise ValueError(f"{where}: missing {missing}")
    return kind(**{name: _value(hints[name], value, f"{where}.{name}", subclasses) for name, value in values.items()})


def _value(hint: Any, value: Any, where: str, subclasses: Mapping[type, type]) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, where, subclasses)  # type: ignore[arg-type]
    if get_args(hint) and all(isinstance(choice, str) for choice in get_args(hint)):
        if value not in get_args(hint):
            raise ValueError(f"{where} = {value!r}: expected one of {', '.join(get_args(hint))}")
        return value
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if not isinstance(value, list) or (kinds[-1] is not ... and len(value) != len(kinds)):
            items = "names" if kinds[0] is str else "numbers"
            raise ValueError(f"{where} = {value!r}: expected a list of {'' if kinds[-1] is ... else f'{len(kinds)} '}{items}")
        return tuple(_value(kinds[0], item, f"{where}[{i}]", subclasses) for i, item in enumerate(value))
    allowed = get_args(hint) or (hint,)
    if float in allowed and type(value) is int:
        return float(value)
    if type(value) not in allowed:
        expected = " or ".join("null" if kind is type(None) else kind.__name__ for kind in allowed)
        raise ValueError(f"{where} = {value!r}: expected {expected}")
    return value
