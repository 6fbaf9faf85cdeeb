"""Tracks against true tracks: CLEAR MOT, HOTA, and nuScenes' averages over recalls."""
