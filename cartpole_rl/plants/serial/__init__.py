"""A cart on a serial port as a plant, from the port upwards.

- `port`, `link`: finding and opening a port; frames over it
- `tracking`, `connection`: the newest, lost, repeated and late states; questions and answers
- `cart`, `errors`: the calls; refusals, latched faults and INFO in words
- `moves`: small moves made by the host; `preflight`: checks of a cart before an agent drives it
- `preparation`, `plant`: the start of an episode; the contract of `specs.Plant`
"""
