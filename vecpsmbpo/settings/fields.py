"""What a setting is: its type, its range, and how a value that does not fit is refused. Knows nothing of JAX."""

import dataclasses
import math
from typing import Any

Range = tuple[float | None, float | None]

# What the program's int32 and float32 hold; smaller numbers are taken for 0.
LARGEST_WHOLE = 2**31 - 1
LARGEST, SMALLEST = 3.4e38, 1.2e-38


class SettingError(Exception):
    """A mistake in a setting: one line that names the setting and what it may be."""


def whole(at_least: int, at_most: int = LARGEST_WHOLE) -> Any:
    """A setting that is a whole number."""
    return dataclasses.field(metadata={"range": (at_least, at_most)})


def real(
    at_least: float | None = None,
    at_most: float | None = None,
    *,
    open_low: bool = False,
    traced: bool = False,
    infinite: bool = False,
) -> Any:
    """A setting that is a real number.

    Args:
        open_low: it must be above `at_least`.
        traced: it is a number inside the compiled program (`types.Hyper`), so that several values fit into one.
        infinite: it may be infinite, too.
    """
    about = {"range": (at_least, at_most), "open_low": open_low, "traced": traced, "infinite": infinite}
    return dataclasses.field(metadata=about)


def choice(*names: str) -> Any:
    """A setting that is one of these words, or a list of some."""
    return dataclasses.field(metadata={"choices": names})


def traced(settings: type) -> list[str]:
    """The settings of a class that are numbers inside the compiled program."""
    return [field.name for field in dataclasses.fields(settings) if field.metadata.get("traced", False)]


def allowed(field: Any) -> str:
    """What a setting may be, in words."""
    if choices := field.metadata.get("choices"):
        return ("a list of " if field.type == tuple[str, ...] else "one of ") + ", ".join(choices)
    kinds: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a name"}
    kinds[tuple[float, ...]] = "a list of numbers, each"
    kind = kinds[field.type]
    low, high = field.metadata.get("range", (None, None))
    above = "above" if field.metadata.get("open_low") else "at least"
    if low is not None and high not in (None, LARGEST_WHOLE):
        return f"{kind} from {low} to {high}" if above == "at least" else f"{kind} above {low} and at most {high}"
    return kind if low is None else f"{kind}, {above} {low}"


def check(field: Any, value: Any) -> Any:
    """`value` as the type of a setting.

    Raises:
        SettingError: the value has the wrong type or lies out of range.
    """
    complaint = SettingError(f"{field.name}={value}: must be {allowed(field)}")
    if field.type is bool:
        if not isinstance(value, bool):
            raise complaint
        return value
    if field.type is str:
        if not isinstance(value, str) or value not in field.metadata.get("choices", (value,)):
            raise complaint
        return value
    if field.type == tuple[str, ...]:
        if not isinstance(value, list | tuple) or any(item not in field.metadata["choices"] for item in value):
            raise complaint
        return tuple(dict.fromkeys(value))
    if field.type == tuple[float, ...]:
        if not isinstance(value, list | tuple) or not value:
            raise complaint
        return tuple(_number(field, item, complaint) for item in value)
    return _number(field, value, complaint)


def _number(field: Any, value: Any, complaint: SettingError) -> Any:
    """`value`, or the item of a list, as a number in the field's range."""
    try:
        number = math.inf if value == ".inf" else float(value)  # as YAML spells it
    except (TypeError, ValueError):
        raise complaint from None
    if isinstance(value, bool) or math.isnan(number):
        raise complaint
    if field.type is int:
        if not math.isfinite(number) or number != int(number):
            raise complaint
        number = int(number)
    elif math.isinf(number) and not field.metadata.get("infinite", False):
        raise complaint
    low, high = field.metadata.get("range", (None, None))
    too_low = low is not None and (number < low or (number == low and field.metadata.get("open_low", False)))
    if field.type is int and number > LARGEST_WHOLE:
        raise SettingError(f"{field.name}={value}: must be at most {LARGEST_WHOLE}")
    if too_low or (high is not None and number > high):
        raise complaint
    if field.type is not int and number and not SMALLEST <= abs(number) <= LARGEST and math.isfinite(number):
        raise SettingError(f"{field.name}={value}: must be 0 or between {SMALLEST} and {LARGEST} in size")
    return number
