"""β by an LSTM that was trained beforehand, on other tasks: ours, and no part of the paper."""
