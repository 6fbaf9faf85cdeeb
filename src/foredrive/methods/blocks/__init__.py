"""Networks that several methods share: backbones, lifting, BEV, published weights."""
