"""Networks whose weights the user installs: XFeat features and the LighterGlue matcher."""
