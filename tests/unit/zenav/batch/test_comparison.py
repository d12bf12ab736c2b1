# SPDX-License-Identifier: Apache-2.0
import pytest

from zenav.batch.comparison import changes, lines, page
from zenav.batch.table import parquet, rows_of


def row(recording, **figures):
    return {"recording": recording, "state": "done", "key": "k", **figures}


def test_what_became_worse_comes_first_and_a_lost_recording_before_all():
    before = [row("a", quality=0.9), row("b", quality=0.5), row("c", placed=1.0), row("gone", quality=1.0)]
    after = [row("a", quality=0.45), row("b", quality=1.0), {**row("c"), "state": "died"}, row("new", quality=0.1)]
    found = changes(before, after)
    assert [(one.recording, one.figure) for one in found] == [("c", "state"), ("a", "quality"), ("b", "quality")]
    assert [one.worse for one in found] == [float("inf"), 0.5, -1.0]
    assert lines(found)[1].endswith("a: quality 0.9 -> 0.45")


def test_cpu_time_that_varies_is_no_change_and_another_trajectory_is():
    before = [row("a", slam_cpu_s=10.0, digest="x"), row("b", slam_cpu_s=10.0, digest="y")]
    after = [row("a", slam_cpu_s=10.5, digest="x"), row("b", slam_cpu_s=10.5, digest="z")]
    assert [(one.recording, one.figure, one.worse) for one in changes(before, after)] == [("b", "digest", 0.0)]


def test_the_page_escapes_names():
    content = page(changes([row("<b>", quality=1.0)], [row("<b>", quality=0.5)]), 1).decode()
    assert "&lt;b&gt;" in content
    assert "<b>" not in content


def test_a_table_keeps_its_rows_by_recording():
    rows = [row("b", quality=0.5), {"recording": "a", "state": "died", "error": "killed", "tries": 2}]
    assert rows_of(parquet(rows)) == [rows[1], rows[0]]


def test_a_recording_whose_content_changed_is_named_and_not_compared():
    before, after = [row("a", input="1", quality=1.0)], [row("a", input="2", quality=0.1)]
    assert [(one.figure, one.worse) for one in changes(before, after)] == [("input", 0.0)]
    assert changes(before, [row("a", input="1", quality=0.1)])[0].figure == "quality"


@pytest.mark.parametrize("ending", ["died", "timeout", "memory", "failed"])
def test_a_recording_that_does_not_come_through_any_more_is_worse(ending):
    done, ended = row("a", input="1"), {"recording": "a", "state": ending, "error": "killed", "tries": 2}
    assert [(one.figure, one.worse) for one in changes([done], [ended])] == [("state", float("inf"))]
    assert [(one.figure, one.worse) for one in changes([ended], [done])] == [("state", float("-inf"))]
    other = {**ended, "state": "refused"}
    assert [(one.figure, one.worse) for one in changes([ended], [other])] == [("state", 0.0)]
