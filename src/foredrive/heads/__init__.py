"""What learns the tasks on a volume: heads with one plane and one decoder, their losses, their training."""
