"""The tuner's network: data, labels, training, evaluation."""
