"""The colours of all figures and pictures.

They are those of Okabe and Ito (2008), "Color Universal Design", which stay distinct for colour-blind
readers, with a brown in place of their yellow. A colour means the same in figures and animations.
"""

BLUE = "#0072B2"
VERMILLION = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
ORANGE = "#E69F00"
SKY = "#56B4E9"
BROWN = "#8C5109"  # darker than Okabe and Ito's yellow, which vanishes on white
BLACK = "#010101"  # matplotlib leaves #000000 out of an SVG: it would stay black on a dark page

INK = "#222222"  # text
MUTED = "#6B6B6B"  # secondary text, guide lines
FAINT = "#E3E3E3"  # grid
PAPER = "#FFFFFF"

POLE = BLUE  # the angle
CART = PURPLE  # the position
MOTOR = ORANGE  # the action
UPRIGHT = GREEN  # |theta| below the upright angle
LIMIT = VERMILLION  # the ends of the track
