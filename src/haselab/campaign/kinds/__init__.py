"""What a case computes."""
