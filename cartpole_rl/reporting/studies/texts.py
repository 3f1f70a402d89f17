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
    "speaks the cart's serial protocol and shares no equation with the simulator; many of its parameters lie "
    "inside the training ranges, see the comments below. The settings below say how it differs from the "
    "nominal cart. It lacks wear, backlash, a bending track and more. With a real cart, plant=serial takes "
    "the place of plant=emulated in the same commands."
)
INTRODUCTION = {  # term: what it means; the carts come before
    "Score (6.1)": "Balance: at most 500.",
    "Score (6.2)": "Swing-up: at most 5500; over 2000 is good.",
    "Values": (
        "Interquartile means over agents with 95 % intervals, as 4104 (4062 to 4177); the last checkpoint of "
        "every seed counts."
    ),
    "Settings": "Thesis's settings: those of the thesis. Today's settings: this package's defaults.",
    "Verdicts": (
        "Agrees, contradicts: compared with the thesis. Answered: the thesis has no result to compare with. "
        "Fails: it does not work."
    ),
    "No difference is shown": "The interval of the difference includes 0.",
    "Ratio": "Score on the emulated cart divided by that in simulation.",
}
EMULATED_CART = (
    'The emulated cart is a separate MuJoCo simulation that stands in for one (<a href="#emulated">more</a>).'
)
ENOUGH = 10  # agents per set-up
STYLE = """
svg * { stroke-linejoin: round; stroke-linecap: butt; }
svg { width: 100%; height: auto; font-family: inherit; }
nav ol { padding-left: 1.8rem; } nav ul { padding-left: 1rem; list-style: none; margin: 0; }
section { margin-top: 2.5rem; border-top: 1px solid var(--faint); }
dt { color: var(--muted); } dd { margin: 0 0 .6rem 0; }
.terms { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.2rem; font-size: .92rem; }
.terms dd { margin: 0; }
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
@media (min-width: 40.01rem) {
  #summary td:nth-child(1) { width: 21%; } #summary td:nth-child(2) { width: 13%; }
  #summary td:nth-child(3) { width: 28%; }
}
@media (max-width: 40rem) {
  .terms { grid-template-columns: 1fr; gap: 0; } .terms dd { margin-bottom: .4rem; }
  .wide table { display: table; } .wide th { white-space: nowrap; } .wide td:not(.number) { min-width: 8rem; }
  .wide { overflow-x: auto; background:
    linear-gradient(to right, var(--paper) 30%, transparent) left / 3rem 100% no-repeat local,
    linear-gradient(to left, var(--paper) 30%, transparent) right / 3rem 100% no-repeat local,
    linear-gradient(to right, var(--muted), transparent) left / 1rem 100% no-repeat scroll,
    linear-gradient(to left, var(--muted), transparent) right / 1rem 100% no-repeat scroll; }
}
@media print {
  details.values:not([open])::details-content { content-visibility: visible; display: block; }
  .figures { grid-template-columns: 1fr 1fr; }
}
"""
