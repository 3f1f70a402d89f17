"""What can be set about drawn carts beside ranges: the carts of an identification."""

from pathlib import Path

from cartpole_rl.randomization.ranges import Range
from cartpole_rl.settings import Fraction, Positive, Settings


class FoundSettings(Settings):
    """Carts as an identification found them, in place of ranges about the nominal cart."""

    posterior: Path  # posterior.npz of cartpole-identify
    widen: Positive  # its uncertainty is multiplied by it
    prior_share: Fraction  # of the carts are nominal ones within `ranges`
    ranges: dict[str, Range]  # of what the identification does not tell
