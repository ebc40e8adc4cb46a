from setuptools import find_packages, setup

setup(
    name="tcbi_contract",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"tcbi_contract": ["**/*.toml", "**/*.json", "**/*.html", "**/*.css", "**/*.js", "**/*.safetensors"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tcbi_contract"]),
        ("share/tcbi_contract", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="Topic names, frames, QoS, joint names and limits in one place.",
    license="Apache-2.0",
)
