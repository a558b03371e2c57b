"""The base of all settings that a scenario may state."""

from functools import cache
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, model_validator


class _NoNumber:
    """Stands for a value that pydantic would take for a number, and is refused in its place."""

    def __init__(self, value: bool | str) -> None:
        self._value = value

    def __repr__(self) -> str:
        return repr(self._value)


class Settings(BaseModel):
    """Immutable settings: unknown names are refused, numbers must be finite, units stand in the names."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _numbers_are_numbers(cls, data: Any) -> Any:
        # True is not 1, and "0.02" is not 0.02. Strict mode would refuse lists for tuples as well.
        if not isinstance(data, dict):
            return data
        numeric = _numeric_fields(cls)
        return {name: _refused(value) if name in numeric else value for name, value in data.items()}


@cache
def _numeric_fields(settings: type[BaseModel]) -> frozenset[str]:
    return frozenset(name for name, f in settings.model_fields.items() if _is_numeric(f.annotation))


def _is_numeric(annotation: Any) -> bool:
    """Whether a type is a number's, or one of lists of numbers and of none."""
    if get_origin(annotation) is Annotated:
        return _is_numeric(get_args(annotation)[0])
    inner = [part for part in get_args(annotation) if part is not Ellipsis]
    if get_origin(annotation) in (tuple, Union, UnionType):
        return all(map(_is_numeric, inner))
    return annotation in (int, float, type(None))


def _refused(value: Any) -> Any:
    """The value with all truth values and texts in it in a guise that is no number's."""
    if isinstance(value, list | tuple):
        return [_refused(part) for part in value]
    return _NoNumber(value) if isinstance(value, bool | str) else value
