"""Other programs' data as a `quad_rl.Dataset`, one source a file. `episodes` is what they share."""
