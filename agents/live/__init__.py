"""Live: estimators and agents on streams of datagrams in real time, and a simulated car at the
other end."""
