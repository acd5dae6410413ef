"""Recorded drives from files: tables into the record of a drive, receivers' NMEA into epochs."""
