"""Loop closing: place index, place recognition, verification, essential graph optimization, map correction."""
