"""Neural networks only: backbones, lifting, NeMo, planners, baselines."""
