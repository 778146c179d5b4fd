import pytest

from haselab.base import InputError
from haselab.report import results_table


def test_the_table_fits_the_terminal_and_names_every_quantity(documents):
    results, _ = documents
    lines = results_table(results).splitlines()
    assert max(map(len, lines)) <= 100
    first_words = [line.split()[0] for line in lines if line]
    for row in results["quantities"]:
        assert row["id"] in first_words
    assert lines[-1] == "11 quantities: 8 agree, 1 disagrees, 2 not in paper"


def test_a_long_cell_is_wrapped_and_nothing_is_lost():
    recomputed = "6.24 and 6.61 rad/s; read as Hz 5.13 and 5.14 Hz, which is 5.1 in both cases"
    measured = {"value": 5.113, "std": 0.02, "ci95": [5.073, 5.153], "unit": "rad/s"}
    row = {"id": "S19.omega_0", "unit": "rad/s", "paper": 5.1, "recomputed": recomputed}
    text = results_table({"quantities": [{**row, "measured": measured, "verdict": "disagrees"}]})
    assert max(map(len, text.splitlines())) <= 100
    start = text.splitlines()[0].index("recomputed")
    stop = text.splitlines()[0].index("measured")
    column = [line[start:stop].strip() for line in text.splitlines()[2:-2]]
    assert " ".join(column).strip() == recomputed


def test_a_fit_without_result_shows_an_empty_cell():
    row = {"id": "S16.mu", "paper": None, "measured": None, "verdict": "not in paper"}
    line = results_table({"quantities": [row]}).splitlines()[2]
    assert line.split() == ["S16.mu", "—", "—"]


def test_columns_about_a_paper_stand_only_where_a_row_is_compared_with_one():
    row = {"id": "S20.zeta", "paper": None, "measured": None, "verdict": "not in paper"}
    head = results_table({"quantities": [row]}).splitlines()[0]
    assert head.split() == ["id", "unit", "measured", "95", "%", "interval"]
    compared = results_table({"quantities": [row, {**row, "id": "S16.mu", "paper": 1.0}]})
    assert {"paper", "recomputed", "agreement"} <= set(compared.splitlines()[0].split())


def test_a_value_without_noise_outside_the_interval_is_said():
    measured = {"value": 5.0, "std": 0.1, "ci95": [4.8, 5.2], "unit": ""}
    row = {"id": "S20.zeta", "measured": measured, "noise_free": 5.3, "verdict": "agrees"}
    text = results_table({"quantities": [row]})
    assert "5.3 (outside)" in text
    assert "(outside): the noise-free result is outside the measured 95 % interval" in text


def test_a_document_of_another_kind_is_refused():
    with pytest.raises(InputError, match="no list 'quantities'"):
        results_table({"poles": []})


def test_counts_are_words_and_what_a_run_lacks_is_listed():
    measured = {"value": 5.1, "std": 0.1, "ci95": [4.9, 5.3], "unit": ""}
    row = {"id": "S20.omega_n", "measured": measured, "paper": 5.1, "verdict": "agrees"}
    missing = [{"ids": ["S26.rise", "S26.error"], "reason": "only 'haselab reproduce' plays it."}]
    text = results_table({"quantities": [row], "not_played": missing})
    assert text.splitlines()[-1] == "1 quantity: 1 agrees"
    assert "no result: S26.rise, S26.error: only 'haselab reproduce' plays it." in text


def test_results_that_the_record_does_not_determine_are_named():
    row = {"id": "S14.a1", "measured": {"value": 1.6, "std": 0.3, "ci95": [1.1, 2.1], "unit": "V"}}
    other = {**row, "id": "S14.zero", "note": "recomputed: eq. 4"}
    text = results_table(
        {"quantities": [{**row, "note": "not identifiable from this loop"}, other]}
    )
    (line,) = [line for line in text.splitlines() if line.startswith("not identifiable")]
    assert line.endswith("(reasons in the report): S14.a1")
    assert "not identifiable" not in results_table({"quantities": [other]})


def test_a_simulated_table_says_that_no_verdict_is_evidence():
    row = {"id": "S20.omega_n", "paper": 5.1, "verdict": "agrees", "follows_from_twin": "mass"}
    text = results_table({"quantities": [row], "simulated": True})
    assert "agrees" in text and "(twin)" in text
    assert "SIMULATED: no verdict is evidence" in text.splitlines()[-1]
