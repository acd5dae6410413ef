"""What happens in an episode: manoeuvres, steering, driver, speed, wind, roads, random draws.

`scenario.Scenario` is what users write; `manoeuvres.SCENARIOS` holds those with a name.
"""
