"""Settings of carts that are drawn from an identification."""

from pathlib import Path

from cartpole_rl.randomization.ranges import Range
from cartpole_rl.settings import Fraction, Positive, Settings


class IdentifiedSettings(Settings):
    """Identified carts, in place of ranges about the nominal cart."""

    posterior: Path  # posterior.npz of cartpole-identify
    widen: Positive  # factor of its uncertainty
    prior_share: Fraction  # of the carts, which are nominal ones within `ranges`
    ranges: dict[str, Range]  # of parameters that are not identified, and of the prior share
