"""What happens in an episode: manoeuvres, steering, driver, speed, wind, roads, random draws.

`scenario.Scenario` is what users write; `manoeuvres.SCENARIOS` and `papers` hold those with a name.
"""
