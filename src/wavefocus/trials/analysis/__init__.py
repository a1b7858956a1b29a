"""Statistics of answers: accuracy, sensitivity, psychometric functions, reaction times; report and BIDS-like folder."""
