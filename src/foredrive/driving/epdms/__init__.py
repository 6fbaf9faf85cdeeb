"""NAVSIM's Extended Predictive Driver Model Score (EPDMS), by the definition of its devkit."""
