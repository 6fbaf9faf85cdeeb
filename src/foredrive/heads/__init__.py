"""Parts of all task heads: one plane, one decoder, one training."""
