"""A cart on a serial port as a plant, from the port upwards.

- `settings`: the port, its timeouts, and how an episode starts
- `port`, `ports`, `link`: finding and opening a port; frames over it
- `connection`, `tracking`, `statistics`: questions and answers; the newest, lost, repeated and late states
- `cart`: the calls; `information`, `errors`, `faults`: INFO, refusals and latched faults
- `moves`, `centring`, `recentring`: small moves made by the host
- `preparation`, `plant`: the start of an episode; the contract of `specs.Plant`
- `probe`, `checks`, `preflight`: checks of a cart before an agent drives it
"""
