"""Files and network: atomic writes, YAML, time stamps, downloads, archives, folder ownership."""
