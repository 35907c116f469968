"""Loop closing: place index, recognition, verification, essential graph, correction."""
