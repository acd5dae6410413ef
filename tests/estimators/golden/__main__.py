"""`python -m tests.estimators.golden`: record what the default filters say now."""

from tests.estimators.golden.recording import record_anew

record_anew()
