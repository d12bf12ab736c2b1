# SPDX-License-Identifier: Apache-2.0
from zenav.bench.sim import N_CELLS, grid_building, measure_speed


def test_the_bench_tells_a_ratio_for_each_world_and_the_promised_one_as_its_summary():
    result = measure_speed(seconds=0.2, repeats=1)
    assert len(result["rows"]) == 3
    assert result["summary"]["ratio"] == result["rows"]["map of 1000 x 1000 cells, 720 beams at 40 Hz"]["ratio"] > 0
    assert all(row["scans_a_second"] > 0 for name, row in result["rows"].items() if "720" in name)


def test_the_bench_drives_in_a_map_of_a_thousand_cells_a_side():
    solid = grid_building(N_CELLS)
    assert solid.shape == (1000, 1000)
    assert 0.05 < solid.mean() < 0.3
    assert (grid_building(N_CELLS) == solid).all()
