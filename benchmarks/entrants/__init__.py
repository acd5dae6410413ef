"""The open benchmark: a user's car, filter, controller or policy beside those of the package."""
