# SPDX-License-Identifier: Apache-2.0
"""Of a test with many cases two days run all of them, and each day runs half."""

from hypothesis import given
from hypothesis import strategies as st

from tests.sampling import FEW, left_out


@given(st.dictionaries(st.text("abc", min_size=1), st.integers(1, 9), max_size=5), st.integers(0, 40_000))
def test_two_days_run_every_case_and_tests_of_few_cases_run_whole_each_day(tests, day):
    cases = {name: [f"{name}[{i}]" for i in range(n)] for name, n in tests.items()}
    names = [case for of_one in cases.values() for case in of_one]
    today, tomorrow = left_out(names, day), left_out(names, day + 1)
    assert not today & tomorrow
    for of_one in cases.values():
        n_left_out = len(today & set(of_one))
        assert n_left_out in ((0,) if len(of_one) < FEW else (len(of_one) // 2, (len(of_one) + 1) // 2))
