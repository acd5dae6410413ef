"""What all tests share."""

from hypothesis import settings

# The first example of a property pays for compilation; the same examples come every time.
settings.register_profile("sideslip", deadline=None, derandomize=True)
settings.load_profile("sideslip")
