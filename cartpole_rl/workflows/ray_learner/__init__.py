"""Fine-tuning with the cart on one machine and the learner on another, over TorchRL's Ray parts.

The machine of the cart runs the session, the driving process and the run folder, none of which know Ray. Two
further processes there can die or hang without harm: the link (`link.py`), which starts a Ray node and the
learner, and TorchRL's collector (`collector.py`), which exchanges files of the run folder with the learner.
The learner's machine runs the learner (`learner.py`) and a replay buffer of whole episodes.

Weights carry a version: the number of episodes that had been learned from. Version n drives episode n, as on
one machine.
"""
