"""What the heads of all tasks share: one plane, one decoder, one training."""
