"""What is known of one cell of motion labels, as records and sentences: `parts`, and `explanation` of them all."""
