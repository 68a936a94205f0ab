"""The curiosity bonus: novelty × what the episodic memory says of similar states."""
