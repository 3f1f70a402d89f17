"""The page and the table of an identification show what they were given."""

from cartpole_rl.reporting.identification import (
    CAPTIONS,
    Estimate,
    PredictionError,
    Recording,
    estimates_table,
    identification_page,
)

ESTIMATES = [
    Estimate("latency", "ms", 12.0, 11.0, 13.0, 5.0),
    Estimate("viscous friction", "1/s", 1.2, 1.1, 1.3, 0.6),
]


def test_the_table_has_values_with_intervals_and_units() -> None:
    rows = [line.split("  ") for line in estimates_table(ESTIMATES).splitlines()[2:]]
    assert [[cell.strip() for cell in row if cell] for row in rows] == [
        ["latency", "12.0 ± 1.0", "ms"],
        ["viscous friction", "1.20 ± 0.10", "1/s"],
    ]


def test_the_page_shows_all_results() -> None:
    recordings = [Recording("ramps", 22.0, "friction at <slow> speed", "time")]
    friction = {"step": PredictionError(1e-3, 0.01), "linear": PredictionError(2e-3, 0.02)}
    text = identification_page(recordings, ESTIMATES, friction, friction["step"], ["check a"], "train x=1")
    for part in ("ramps", "&lt;slow&gt;", "12.0 ± 1.0 ms", "0.600 1/s", "2.00", "check a", "train x=1"):
        assert part in text
    assert "1.00 mm and 0.57 deg" in text
    for name, caption in CAPTIONS.items():
        assert f'src="figures/{name}.png" alt="{caption}"' in text


def test_without_warnings_it_says_so() -> None:
    text = identification_page([], ESTIMATES, {}, PredictionError(0, 0), [], "train")
    assert "<h2>Warnings</h2>\n<ul><li>None.</li></ul>" in text
