# SPDX-License-Identifier: Apache-2.0
"""Settings of the mapper under their former names, as robot files and recordings give them."""

import pytest

from services.mapper.config import MapperConfig
from shared.config import Section


def sections(model: type[Section]) -> list[type[Section]]:
    """The model and all sections below it."""
    below = [f.annotation for f in model.model_fields.values()]
    return [model, *(s for b in below if isinstance(b, type) and issubclass(b, Section) for s in sections(b))]


@pytest.mark.parametrize("model", dict.fromkeys(sections(MapperConfig)))
def test_each_former_name_sets_the_setting_that_took_its_place(model):
    defaults = model().model_dump()
    assert model.RENAMED.keys().isdisjoint(model.model_fields)
    for old, new in model.RENAMED.items():
        assert model.model_validate({old: defaults[new]}).model_dump() == defaults
        assert new in model.model_validate({old: defaults[new]}).model_fields_set


def test_a_robot_file_of_before_the_renaming_is_read():
    config = MapperConfig.model_validate(
        {
            "loops": {"apart": 9.0, "search": {"rival": 0.5}},
            "finding": {"near": 2.0},
            "back_end": {"ties": {"gate": 0.3}},
        }
    )
    assert config.loop_closure.min_path_between == 9.0
    assert config.loop_closure.search.min_rival_ratio == 0.5
    assert config.global_localization.window == 2.0
    assert config.back_end.pairwise.max_correspondence == 0.3
