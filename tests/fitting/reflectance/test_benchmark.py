from __future__ import annotations

from workstation.benchmarks.reflectance import bench


def test_records_without_measured_data(monkeypatch):
    monkeypatch.delenv("IMPASTO_REAL_DATA", raising=False)
    found = bench(oracle_texels=8, timed_texels=640, truth_texels=1000, painting_width=None)
    records = {record.name: record for record in found}
    assert set(records) == {
        "oracle.share_within",
        "solver.texels_per_s",
        "solver.speed_over_nlopt",
        "solver.time_growth",
        "lafortune.z_spread",
        "lafortune.unobserved_flagged",
        "lafortune.roughness_over_predicted",
        "solver.stress_passed",
    }
    for name in ("lafortune.z_spread", "lafortune.unobserved_flagged", "solver.stress_passed"):
        assert records[name].holds, records[name].note
    assert records["oracle.share_within"].value >= 0.75
    assert records["solver.texels_per_s"].value > 0
