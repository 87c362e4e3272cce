"""Maps in another frame: which transform (`chains`), which cells (`warping`), of labels (`to_present`), of features."""
