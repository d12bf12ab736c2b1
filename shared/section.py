# SPDX-License-Identifier: Apache-2.0
"""The base of every configuration model."""

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, model_validator


class Section(BaseModel):
    """Base of every configuration model: unknown keys are errors, values never change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    RENAMED: ClassVar[dict[str, str]] = {}
    """Former name of a setting: its present name. Robot files and recordings may use either, not both."""

    @model_validator(mode="before")
    @classmethod
    def _rename_settings(cls, values: Any) -> Any:
        """The values under the present names of the settings. Raises ValueError where both names are given."""
        if not isinstance(values, dict) or not cls.RENAMED.keys() & values.keys():
            return values
        for old, new in cls.RENAMED.items():
            if old in values and new in values:
                raise ValueError(f"`{old}` and `{new}` name one setting: give `{new}` only")
        return {cls.RENAMED.get(name, name): value for name, value in values.items()}
