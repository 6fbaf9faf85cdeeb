"""Safety tests in reconstructed logs after NeuroNCAP: scenarios, rules, drives and scores."""
