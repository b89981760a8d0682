"""The sweep file: a base scene, and what its keys are to be from run to run."""

from __future__ import annotations

import copy
import itertools
import json
import math
import string
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from ..errors import InputError, suggestion
from ..scene import Number, Positive, Table, refuse
from ..scenefile import explain, read_toml

# More runs than this would be a typing error.
MAX_RUNS = 10_000
# Longer names would be unwieldy; file systems take 255 bytes.
MAX_NAME = 100
# Steps of ranges are rounded to so many digits, draws to so many: what is listed is what runs, and fits into names.
RANGE_DIGITS, DRAW_DIGITS = 12, 6
# Ways to say which values a parameter takes, of which each has one.
_RANGES = ("range", "log_range")
_DRAWS = ("uniform", "log_uniform", "normal", "integers")
_SOURCES = ("values", *_RANGES, *_DRAWS)
_FORMS = "give a list of values, or a table with one of " + ", ".join(_SOURCES)

Whole = Annotated[int, Field(strict=True, ge=-(2**53), le=2**53)]
Count = Annotated[int, Field(strict=True, ge=1, le=MAX_RUNS)]


class Parameter(Table):
    """What one key of the scene, or several at once, are to be from run to run."""

    keys: list[str] | None = Field(
        None,
        min_length=1,
        description="keys of the scene that all get the value; unless given, the parameter's own name is the key",
    )
    values: list[Any] | None = Field(None, min_length=1, description="these")
    range: tuple[Number, Number] | None = Field(
        None, description="from the first to the second, both included, in `count` equal steps"
    )
    log_range: tuple[Positive, Positive] | None = Field(None, description="the same in steps of equal ratio")
    uniform: tuple[Number, Number] | None = Field(
        None, description="`count` random numbers, evenly spread between the first and the second"
    )
    log_uniform: tuple[Positive, Positive] | None = Field(
        None, description="`count` random numbers whose logarithms are evenly spread"
    )
    normal: tuple[Number, Positive] | None = Field(
        None, description="`count` random numbers about a mean with a standard deviation"
    )
    integers: tuple[Whole, Whole] | None = Field(
        None, description="`count` random whole numbers from the first to the second, both included"
    )
    count: Count | None = Field(
        None, description="number of values; with combine zip as many as the other parameters have unless given"
    )

    @model_validator(mode="after")
    def _values_come_from_one_place(self) -> Self:
        given = [name for name in _SOURCES if getattr(self, name) is not None]
        if len(given) != 1:
            raise PydanticCustomError("parameter", "give one of {sources}", {"sources": ", ".join(_SOURCES)})
        if self.values is not None and self.count is not None:
            refuse("count", self.count, "a list has as many values as it has; leave count out")
        for number, value in enumerate(self.values or ()):
            if not _is_finite(value):
                refuse(f"values.{number}", value, "no scene takes numbers that are not finite")
        for name in ("range", "log_range", "uniform", "log_uniform", "integers"):
            bounds = getattr(self, name)
            if bounds is not None and not bounds[0] < bounds[1]:
                refuse(name, list(bounds), "the first number must be below the second")
        return self

    @property
    def length(self) -> int | None:
        """Number of values; None where it follows from other parameters."""
        return self.count if self.values is None else len(self.values)

    def spread(self, count: int, seed: Sequence[int]) -> list[Any]:
        """Return so many values; draws are those of the seed, the same first ones whatever the count."""
        if self.values is not None:
            return copy.deepcopy(self.values)
        rng = np.random.default_rng(list(seed))
        if self.range is not None:
            numbers, digits = np.linspace(*self.range, count), RANGE_DIGITS
            if all(float(bound).is_integer() for bound in self.range) and np.all(numbers == np.round(numbers)):
                return [int(number) for number in numbers]
        elif self.log_range is not None:
            numbers, digits = np.geomspace(*self.log_range, count), RANGE_DIGITS
        elif self.uniform is not None:
            numbers, digits = rng.uniform(*self.uniform, count), DRAW_DIGITS
        elif self.log_uniform is not None:
            numbers, digits = (
                np.exp(rng.uniform(math.log(self.log_uniform[0]), math.log(self.log_uniform[1]), count)),
                DRAW_DIGITS,
            )
        elif self.normal is not None:
            numbers, digits = rng.normal(*self.normal, count), DRAW_DIGITS
        else:
            assert self.integers is not None
            return [int(number) for number in rng.integers(*self.integers, count, endpoint=True)]
        return [float(f"{number:.{digits}g}") for number in numbers]


def _is_finite(value: Any) -> bool:
    """Say whether all numbers in a value of TOML are ones that JSON has, too."""
    try:
        json.dumps(value, allow_nan=False, default=str)
    except ValueError:
        return False
    return True


def _as_parameter(given: Any) -> Any:
    return {"values": given} if isinstance(given, list) else given


def flatten(node: Mapping[str, Any], leaves: frozenset[str] = frozenset(), prefix: str = "") -> dict[str, Any]:
    """Return nested tables by dotted key, as if every key had been written in quotes.

    Args:
        node: the tables.
        leaves: a table that has one of these keys is a value.
        prefix: of the keys.
    """
    flat: dict[str, Any] = {}
    for key, value in node.items():
        if isinstance(value, Mapping) and not leaves & value.keys():
            flat |= flatten(value, leaves, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


_PARAMETER_KEYS = frozenset({*_SOURCES, "keys", "count"})


class Sweep(Table):
    """A family of runs: a base scene, and what its keys are to be from run to run."""

    base: Path = Field(description="the scene, .toml or .w, relative to the sweep file")
    vary: dict[str, Annotated[Parameter, BeforeValidator(_as_parameter)]] = Field(
        min_length=1, description="by dotted key of the scene, as --set takes it, what it is to be from run to run"
    )
    combine: Literal["product", "zip"] = Field(
        "product",
        description="product: a run for each combination of values, the last parameter changing fastest; zip: one for "
        "the first values of all parameters, one for the second ones, and so on",
    )
    seed: int = Field(0, strict=True, ge=0, description="of random numbers; each parameter has its own sequence")
    name: str | None = Field(
        None,
        min_length=1,
        description="of each run, with {parameter} for values and {number} for the run's number; made from the values "
        "unless given. {parameter:.3g} says how to write a number",
    )
    set: dict[str, Any] = Field({}, description="by dotted key, what is the same in all runs instead of the base's")
    expect: dict[str, Any] | None = Field(
        None, description="what each run expects of itself, as in a scene, instead of what the base expects"
    )

    @field_validator("vary", mode="before")
    @classmethod
    def _parameters_go_by_dotted_key(cls, vary: Any) -> Any:
        if not isinstance(vary, Mapping):
            return vary
        flat = flatten(vary, _PARAMETER_KEYS)
        for key, value in flat.items():
            if not isinstance(value, list | Mapping | Parameter):
                refuse(key, value, _FORMS)
        return flat

    @field_validator("set", mode="before")
    @classmethod
    def _settings_go_by_dotted_key(cls, settings: Any) -> Any:
        return flatten(settings) if isinstance(settings, Mapping) else settings

    @field_validator("base", mode="after")
    @classmethod
    def _base_is_relative_to_the_sweep(cls, base: Path, info: ValidationInfo) -> Path:
        return (info.context or {}).get("folder", Path()) / base

    @model_validator(mode="after")
    def _there_is_a_number_of_runs(self) -> Self:
        taken: dict[str, str] = {}
        for name, parameter in self.vary.items():
            for key in parameter.keys or [name]:
                if key in taken:
                    refuse(f"vary.{name}", key, f"is what '{taken[key]}' varies, too")
                taken[key] = name
        for key, name in taken.items():
            if whole := self.varied_by(key.rpartition(".")[0]):
                refuse(f"vary.{name}", key, f"is a part of what '{whole}' varies")
        for key, value in self.set.items():
            if by := self.varied_by(key):
                refuse(f"set.{key}", value, f"is what '{by}' varies")
        lengths = {name: parameter.length for name, parameter in self.vary.items()}
        if self.combine == "zip":
            known = {length for length in lengths.values() if length is not None}
            if not known:
                refuse(
                    f"vary.{next(iter(lengths))}.count", None, "missing; no parameter says how many values there are"
                )
            if len(known) > 1:
                told = ", ".join(f"{name} has {length}" for name, length in lengths.items() if length is not None)
                refuse("combine", "zip", f"the parameters must have equally many values: {told}")
        else:
            for name, length in lengths.items():
                if length is None:
                    refuse(f"vary.{name}.count", None, "missing; combine product needs the number of values")
        for name, parameter in self.vary.items():
            if (parameter.range or parameter.log_range) and (parameter.length or self.run_count) == 1:
                refuse(f"vary.{name}.count", 1, "a range has both its ends, so at least 2 values")
        if self.run_count > MAX_RUNS:
            refuse("combine", self.combine, f"makes {self.run_count:,} runs; at most {MAX_RUNS:,} make sense")
        return self

    @property
    def run_count(self) -> int:
        """Number of runs."""
        lengths = [length for parameter in self.vary.values() if (length := parameter.length) is not None]
        return math.prod(lengths) if self.combine == "product" else max(lengths)

    def varied_by(self, key: str) -> str | None:
        """Return the name of the parameter that varies a key of the scene, or a table or list that it is in."""
        names = {varied: name for name, parameter in self.vary.items() for varied in parameter.keys or [name]}
        parts = key.split(".")
        return next((names[k] for n in range(len(parts), 0, -1) if (k := ".".join(parts[:n])) in names), None)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield the values of the parameters by name, run by run."""
        columns = [
            # A sequence of its own, so that a parameter that comes or goes leaves the draws of the others alone.
            parameter.spread(parameter.length or self.run_count, (self.seed, *name.encode()))
            for name, parameter in self.vary.items()
        ]
        combined = itertools.product(*columns) if self.combine == "product" else zip(*columns, strict=True)
        for values in combined:
            yield dict(zip(self.vary, values, strict=True))

    def overrides(self, row: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a run has instead of the base's values, by dotted key of the scene.

        Args:
            row: values of its parameters.
            given: what was asked for beside the sweep, which comes before ``set``.
        """
        varied = {key: value for name, value in row.items() for key in self.vary[name].keys or [name]}
        expected = {} if self.expect is None else {"expect": self.expect}
        return copy.deepcopy({**expected, **self.set, **given, **varied})


def read_sweep(path: Path) -> Sweep:
    """Read a sweep file.

    Raises:
        InputError: it cannot be read or is not sound; the message names the file, the key and the value.
    """
    try:
        return Sweep.model_validate(read_toml(path), context={"folder": path.parent})
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error, Sweep)}") from error


def is_sweep(data: Mapping[str, Any]) -> bool:
    """Say whether the tables of a file are those of a sweep, not of a scene."""
    return bool({"base", "vary"} & data.keys())


@dataclass(frozen=True)
class _Part:
    """A piece of the text that names are made by: what is written as it is, then maybe a value."""

    text: str
    parameter: str | None
    style: str


def run_names(sweep: Sweep) -> list[str]:
    """Return the name of each run.

    Raises:
        InputError: the sweep's own text for names is not sound, or gives two runs the same name.
    """
    rows = list(sweep.rows())
    digits = len(str(len(rows)))
    numbers = [f"{number:0{digits}}" for number in range(1, len(rows) + 1)]
    if sweep.name is None:
        labels = _labels(list(sweep.vary))
        names = ["_".join(f"{labels[key]}-{_written(value)}" for key, value in row.items()) for row in rows]
        unique = len({name.casefold() for name in names}) == len(names)
        return names if unique and max(map(len, names)) <= MAX_NAME else [f"run_{number}" for number in numbers]
    parts = _parts(sweep, digits)
    names = [
        "".join(part.text + _filled(part, {**row, "number": number}, sweep.name) for part in parts)
        for number, row in enumerate(rows, 1)
    ]
    (name, count), *_ = Counter(names).most_common(1)
    if count > 1:
        raise InputError(
            f"name = {json.dumps(sweep.name)}: {count} runs are called '{name}'; add the parameters in which they "
            "differ, or {number}"
        )
    return names


def _parts(sweep: Sweep, digits: int) -> list[_Part]:
    """Take the text for names apart; numbers of runs have so many digits unless it says how to write them."""
    assert sweep.name is not None
    what = f"name = {json.dumps(sweep.name)}"
    try:
        pieces = list(string.Formatter().parse(sweep.name))
    except ValueError as error:
        raise InputError(f"{what}: not a text with {{parameter}}s: {error}") from error
    if converted := next((field for _, field, _, conversion in pieces if conversion), None):
        raise InputError(f"{what}: {{{converted}}} takes no conversion with !")
    styles = {"number": f"0{digits}"}
    parts = [_Part(text, field, style or styles.get(field or "", "")) for text, field, style, _ in pieces]
    known = [*sweep.vary, "number"]
    for part in parts:
        if part.parameter == "number" and "number" in sweep.vary:
            raise InputError(f"{what}: {{number}} is that of the run; give the parameter 'number' another name")
        if part.parameter is not None and part.parameter not in known:
            raise InputError(f"{what}: no parameter '{part.parameter}'; {suggestion(part.parameter, known)}")
    return parts


def _filled(part: _Part, row: Mapping[str, Any], template: str) -> str:
    """Write the value that comes after a piece of text."""
    if part.parameter is None:
        return ""
    value = row[part.parameter]
    try:
        return _clean(format(value, part.style)) if part.style else _written(value)
    except (ValueError, TypeError) as error:
        what = f"{{{part.parameter}:{part.style}}}"
        raise InputError(f"name = {json.dumps(template)}: {what} cannot write {value!r}: {error}") from error


def _labels(names: Sequence[str]) -> dict[str, str]:
    """Return the shortest last parts that tell dotted names apart; a number is not alone."""
    labels = {}
    for name in names:
        parts = name.split(".")
        for size in range(1, len(parts) + 1):
            label = parts[-size:]
            alike = [other for other in names if other.split(".")[-size:] == label]
            if len(alike) == 1 and not label[0].isdigit():
                break
        labels[name] = _clean(".".join(label))
    return labels


def _written(value: Any) -> str:
    """Write a value so that it can be part of a name."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return format(value, f".{RANGE_DIGITS}g")
    if isinstance(value, list):
        return "_".join(map(_written, value))
    return _clean(value if isinstance(value, str) else json.dumps(value, default=str))


def _clean(text: str) -> str:
    """Put _ in the place of what has no place in names."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_.+-=,") else "_" for c in text)


if __name__ == "__main__":
    print(json.dumps(Sweep.model_json_schema(), indent=2))
