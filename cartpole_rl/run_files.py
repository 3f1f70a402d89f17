"""The names of the files and folders in a run folder that more than one module uses."""

CONFIG, PROVENANCE, MULTIRUN = "config.yaml", "provenance.json", "multirun.yaml"
LOG = "log.txt"  # what a run of scripts/reproduce printed
ERROR = "error.txt"  # why a job of a sweep has no result
METRICS = "metrics.json"  # of an evaluation
HISTORY = "history.jsonl"  # of a training: a line for each evaluation
COMPARISON = "comparison.json"  # of a fine-tuning: metrics before and after
PAGE = "page.html"  # of an identification and of a report
IDENTIFIED, MODELLED = "identification.json", "model.json"  # results of these commands
FIGURES, RECORDINGS = "figures", "recordings"
ANIMATION, BESIDE_SIMULATION = "episode.gif", "beside_simulation.gif"  # of the first episode
CHECKPOINTS, LAST, BEST, RESUME = "checkpoints", "last.pt", "best.pt", "resume.pt"  # of an agent
START = "start.pt"  # in checkpoints/ of an unfinished fine-tuning: a copy of the agent that it started from
CART, POLE, RANDOMIZATION, POSTERIOR = "cart.yaml", "pole.yaml", "randomization.yaml", "posterior.npz"
