"""Live: estimators and agents on streams of datagrams in real time, and a simulated other end."""
