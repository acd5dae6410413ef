"""One env-step on packed numbers: layout, reset, tick, step, outputs; batch and lanes.

`layout` names every number of a packed car and has the views of an episode, `config` packs a
scenario into them, `tick` is one millisecond, `step` one env-step of one car, `outputs` its packets
and observation, `batch` the step of many cars, side by side in SIMD registers.

Args:
    row: `EpisodeArrays` of an episode, read and written; those of a block have one axis more.
    p: Packed parameters, shape (PARAMS_WIDTH,).
    params: Parameters of a step, read from them.
    switches: `Switches` of the episode.
    variant: Variant of the ticks.
    start: Packed start of an episode.
    action: Fractions of full scale of the yaw moment and, if there are two, the added steering.
    n: Number of ticks of a step, or of their fast rows.
    done: Ticks that are integrated.
    count: Number of packets.
    inputs: Inputs of the tick.
    state: State at the tick's start.
    tick: Tick since the start of the episode.
    refs: (beta_ref, gamma_ref) (rad, rad/s).
    key_low: Lower 32 bits of the episode's key.
    key_high: Its upper 32 bits.
"""
