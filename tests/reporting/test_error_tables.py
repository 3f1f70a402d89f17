"""Tables of prediction errors have a row for each time, with units in the headings."""

from cartpole_rl.reporting.error_tables import model_table, replay_table, spread_table

ERRORS = {"rms_x_mm": 1.234, "median_x_mm": 1.0, "rms_theta_deg": 0.5, "median_theta_deg": 0.25}
SPREADS = {"rms_spread_x_mm": 2.0, "rms_spread_theta_deg": 1.0, "within_x_mm": 0.9, "within_theta_deg": 1.0}


def test_a_replay_has_a_row_for_each_time() -> None:
    heading, columns, _, *rows = replay_table(
        [{"after_s": time, **ERRORS} for time in (0.1, 1.0)], "errors"
    ).splitlines()
    assert heading == "errors"
    assert columns.split("  ")[0] == "time (s)"
    assert "cart RMS (mm)" in columns
    assert [row.split() for row in rows] == [
        ["0.1", "1.23", "1.00", "0.500", "0.250"],
        ["1", "1.23", "1.00", "0.500", "0.250"],
    ]


def test_models_are_compared_at_each_time() -> None:
    lines = [{"after_s": 0.1, **ERRORS}]
    rows = model_table({"physics": lines, "learned": lines}, "errors").splitlines()[3:]
    assert [row.split()[:2] for row in rows] == [["0.1", "physics"], ["learned", "1.23"]]


def test_errors_are_listed_with_spreads() -> None:
    text = spread_table([{"after_s": 0.5, **ERRORS, **SPREADS}], 2.0, "spreads")
    assert "within 2 spreads" in text
    assert text.splitlines()[-1].split() == ["0.5", "1.23", "/", "2.00", "90%", "0.500", "/", "1.00", "100%"]
