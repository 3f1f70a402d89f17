"""The texts and the style sheet of the pages of studies and of runs."""

TITLE = "The thesis, carried out"
METHOD = (
    "Each number of an agent is the mean over its evaluation episodes; the last checkpoint of every seed "
    "counts and no agent is picked. A controller without training counts once per seed of its evaluation. "
    "Values are interquartile means over agents (the mean without the lowest and the highest quarter) with "
    "the 95 % interval of a stratified bootstrap over agents, after Agarwal et al. (2021). With ten agents "
    "about 94 of 100 such intervals cover the true value, with three only 73. Runs that are unfinished, "
    "damaged, or of other versions or settings than the rest are named and do not count."
)
EMULATED = (
    "The emulated cart is an emulator, not a real cart: a separate program with the physics of MuJoCo that "
    "speaks the cart's serial protocol and shares no equation with the simulator. The settings below say how "
    "it differs from the nominal cart. It lacks wear, backlash, a bending track and more. With a real cart, "
    "plant=serial takes the place of plant=emulated in the same commands."
)
ENOUGH = 10  # agents per set-up
STYLE = """
svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg { width: 100%; height: auto; font-family: inherit; }
nav ol { padding-left: 1.8rem; } nav ul { padding-left: 1rem; list-style: none; margin: 0; }
section { margin-top: 2.5rem; border-top: 1px solid var(--faint); }
dt { color: var(--muted); } dd { margin: 0 0 .6rem 0; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr));
  gap: 1.2rem; }
.animations { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 14rem), 1fr));
  gap: .6rem; }
figure { margin: 0; } figcaption { color: var(--muted); font-size: .85rem; }
.box { border: 1px solid var(--alarm); border-left-width: 6px; border-radius: 4px;
  padding: .2rem .9rem; margin: 1rem 0; }
.box ul { padding-left: 1.2rem; margin: .3rem 0; }
.alarm { color: var(--alarm); font-weight: 600; }
pre { white-space: pre-wrap; background: var(--faint); padding: .5rem .7rem; border-radius: 4px; }
pre code { padding: 0; }
summary { cursor: pointer; color: var(--link); }
table { margin: 1rem 0; } h3 { font-size: 1rem; margin: 1.6rem 0 .5rem; } details { margin: .8rem 0; }
@media print { details:not([open])::details-content { content-visibility: visible; display: block; } }
"""
