"""A small study to make pages of, and to damage."""

from small_study import edit as edit
from small_study import made as made
from small_study import study as study
