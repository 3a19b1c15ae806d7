"""From a rig file to recordings: the streams of a rig, a spool that outlasts a crash, and what is sealed of it."""
