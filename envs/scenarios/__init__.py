"""What happens in an episode: manoeuvres, steering, driver, speed, wind, roads, random draws.

`scenario.Scenario` is what users write; `manoeuvres.SCENARIOS` holds those with a name.

Args:
    d: `Draws` of the episode.
    car: `CarParams` of the vehicle.
    target: `ReferenceParams` of the nominal car, which the driver knows.
    driver: `DriverParams`.
    motion: `Motion` of the car.
    road: `RoadParams`.
    wind: `Wind`.
    tick: Tick since the start of the episode.
    kind: Index of a steering in `STEERING_KINDS`.
    profile: Array that begins with the STEERING_WIDTH numbers of a steering; or `SpeedProfile`.
    angle: Present steering angle at the wheels (rad).
    stop: Largest angle (rad).
    speed: Speed of the car (m/s).
    length: Length of the gentle driving before a manoeuvre (ticks), positive.
    duration: The same in s.
    track: Name of a track, of `PATHS`.
    width: Width of the vehicle (m).
    path: `TrackPath`.
    start: Place along the road where a track or a weave begins (m).
    scale: Factor on a track's lengths.
    side: 1, or -1 to mirror a track.
    s: Distance along the road (m).
"""
