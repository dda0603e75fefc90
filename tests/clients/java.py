"""A client in Java that openapi-generator makes.

It needs Debian's packages default-jdk-headless, libjackson2-databind-java, libhttpmime-java and
libjakarta-annotation-api-java.
"""

import re
import subprocess
from pathlib import Path

from shapespace.service.http.openapi import TARGET

JARS = Path("/usr/share/java")
LIBRARIES = ["jackson-annotations", "jackson-core", "jackson-databind", "httpclient", "httpcore", "httpmime"]
LIBRARIES += ["commons-logging", "jakarta-annotation-api"]
PROPERTIES = "openApiNullable=false,documentationProvider=none,useJakartaEe=true"


def build(generator: Path, folder: Path) -> str:
    """Generate and compile the client in a folder; return the class path."""
    options = ["-g", "java", "--library", "native", f"--additional-properties={PROPERTIES}"]
    command = [generator, "generate", "-i", TARGET, "-o", folder, *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    source = folder / "src" / "main" / "java" / "org" / "openapitools" / "client"
    # Jackson's module for dates is in no package of Debian, and no answer has dates.
    for name in ("RFC3339JavaTimeModule", "RFC3339InstantDeserializer"):
        (source / f"{name}.java").unlink()
    for file in (source / "ApiClient.java", source / "JSON.java"):
        text = file.read_text(encoding="utf-8")
        file.write_text(re.sub(r".*(jsr310|JavaTimeModule).*\n", "", text), encoding="utf-8")
    path = ":".join([str(folder), *(str(JARS / f"{name}.jar") for name in LIBRARIES)])
    sources = [*source.rglob("*.java"), Path(__file__).with_name("Generated.java")]
    subprocess.run(["javac", "-nowarn", "-cp", path, "-d", folder, *sources], check=True)
    return path


def call(path: str, address: str) -> str:
    """Call a server; return the sizes of a mesh and an animation, and a code."""
    command = ["java", "-cp", path, "Generated", address]
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
