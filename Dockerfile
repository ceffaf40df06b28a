# The nodes and commands on ROS 2 Jazzy. Built and run:
#   docker build -t rov_ident . && docker run --rm -v "$PWD/out:/out" rov_ident
# without a command it runs the demo, whose report is then out/demo/report.html.
FROM ros:jazzy

WORKDIR /rov_ident
COPY package.xml .
# What Ubuntu has comes from apt, as package.xml lists it; the rest by pip, into an environment of
# its own that sees the system's packages, rclpy among them.
RUN apt-get update && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths . --ignore-src --dependency-types exec --default-yes \
    && apt-get install --yes --no-install-recommends python3-venv \
    && rm -rf /var/lib/apt/lists/*
COPY . .
RUN python3 -m venv --system-site-packages /opt/rov_ident \
    && /opt/rov_ident/bin/pip install --no-cache-dir .
ENV PATH=/opt/rov_ident/bin:$PATH
CMD ["rov-ident", "demo", "--out", "/out/demo"]
