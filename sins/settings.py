"""The base of all settings that a scenario may state."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Immutable settings: unknown names are refused, numbers must be finite, units stand in the names."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
