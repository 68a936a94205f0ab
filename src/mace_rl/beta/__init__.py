"""What sets β, the weight of the curiosity bonus, episode by episode."""
