"""ORB features, their matching, and poses from matches."""
