"""The names of the files and folders in a run folder that more than one module uses."""

CONFIG, PROVENANCE, MULTIRUN = "config.yaml", "provenance.json", "multirun.yaml"
ERROR = "error.txt"  # why a job of a sweep has no result
METRICS = "metrics.json"  # of an evaluation
FIGURES, RECORDINGS = "figures", "recordings"
CHECKPOINTS, LAST, BEST, RESUME = "checkpoints", "last.pt", "best.pt", "resume.pt"  # of an agent
CART, POLE, RANDOMIZATION, POSTERIOR = "cart.yaml", "pole.yaml", "randomization.yaml", "posterior.npz"
