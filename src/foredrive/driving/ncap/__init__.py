"""Safety tests in rebuilt logs after NeuroNCAP: scenarios, rules, drives and scores."""
