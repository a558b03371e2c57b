"""The base of all settings that a scenario may state."""

from typing import Any

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
        numbers = {name for name, field in cls.model_fields.items() if field.annotation in (int, float)}
        return {
            name: _NoNumber(value) if name in numbers and isinstance(value, bool | str) else value
            for name, value in data.items()
        }
