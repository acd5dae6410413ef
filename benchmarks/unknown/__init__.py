"""What it costs to know neither tyres nor noise: conditions, drives, curves, and the suite."""
